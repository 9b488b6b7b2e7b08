"""The interpreter of the compared programs, so that programs are compared and not builds of Python."""

import os
import subprocess
import sys
import sysconfig
from pathlib import Path
from typing import Final

SYSTEM_PYTHON: Final = Path("/usr/bin/python3")


def can_import(*modules: str) -> bool:
    """Whether the system's Python has these modules, e.g. of Debian's ROS 1."""
    if not SYSTEM_PYTHON.exists():
        return False
    check = [str(SYSTEM_PYTHON), "-c", f"import {', '.join(modules)}"]
    return subprocess.run(check, capture_output=True, check=False).returncode == 0


def go_on_in_the_systems_python() -> None:
    """Restart this program in the system's Python, with our packages, if it has our version."""
    if Path(sys.executable).resolve() != SYSTEM_PYTHON.resolve():
        version = [str(SYSTEM_PYTHON), "-c", "import sys; print(*sys.version_info[:2])"]
        answer = subprocess.run(version, capture_output=True, check=False, text=True)
        if answer.stdout.split() == [str(number) for number in sys.version_info[:2]]:
            library = Path(sysconfig.get_path("stdlib")).parent
            packages = [path for path in sys.path[1:] if "-packages" in path or library not in Path(path).parents]
            environment = {**os.environ, "PYTHONPATH": os.pathsep.join(packages)}
            os.execve(SYSTEM_PYTHON, [str(SYSTEM_PYTHON), *sys.argv], environment)
    print(f"interpreter: {sys.executable}, {sys.version}")
