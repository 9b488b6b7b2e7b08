"""Versions of the running software, for the interpretation of logs."""

import platform
import shutil
import subprocess
from collections.abc import Mapping
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from types import MappingProxyType
from typing import Final

from monstertruckd import __version__

PACKAGES: Final = ("eclipse-zenoh", "mcap", "numpy", "pydantic", "uvloop")
ROOT: Final = Path(__file__).resolve().parents[2]


@cache
def running_versions() -> Mapping[str, str]:
    """Versions of this package, its libraries, the interpreter and the system, and the state of a git checkout."""
    found = {
        "monstertruckd": __version__,
        "python": platform.python_version(),
        "machine": platform.machine(),
        "kernel": platform.release(),
        "system": _system(),
        **{name: text for name in PACKAGES if (text := _version(name)) is not None},
    }
    if (state := checkout(ROOT)) is not None:
        found["git"] = state
    return MappingProxyType(found)


def checkout(root: Path) -> str | None:
    """Return the commit of a git checkout, with ``-dirty`` if files differ; None without a checkout or git."""
    git = shutil.which("git")
    if git is None or not (root / ".git").exists():
        return None
    command = [git, "-C", str(root), "describe", "--always", "--dirty", "--abbrev=12"]
    try:
        # 2.0: timeout of git (s)
        answer = subprocess.run(command, capture_output=True, text=True, timeout=2.0, check=True)  # noqa: S603
    except (OSError, subprocess.SubprocessError):
        return None
    return answer.stdout.strip()


def _system() -> str:
    try:
        return platform.freedesktop_os_release().get("PRETTY_NAME", platform.system())
    except OSError:
        return platform.system()


def _version(package: str) -> str | None:
    try:
        return version(package)
    except PackageNotFoundError:
        return None
