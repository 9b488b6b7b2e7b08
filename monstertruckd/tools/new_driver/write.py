"""Writes the package of a new driver from the templates of its kind."""

import re
import shutil
import tempfile
from enum import StrEnum
from pathlib import Path
from string import Template
from typing import Final

from monstertruck_runtime.errors import InputError

TEMPLATES: Final = Path(__file__).with_name("templates")
_NAME: Final = re.compile(r"[a-z][a-z0-9]*(_[a-z0-9]+)*")


class DriverKind(StrEnum):
    """What the device does."""

    LIDAR = "lidar"
    """Streams the beams of a turning head."""
    SENSOR = "sensor"
    """Answers when it is asked; an inertial measurement unit."""
    MOTORS = "motors"
    """Drives the shafts of one board."""


def write_driver(kind: DriverKind, name: str, parent: Path) -> Path:
    """Write the folder of a driver's package.

    Args:
        kind: what the device does.
        name: value of ``kind`` in a configuration: small letters, digits and _.
        parent: gets the folder, named as the driver.

    Raises:
        InputError: a bad name, or a taken one; or the folder exists or cannot be made.
    """
    from monstertruck_drivers.catalog import DEVICES  # noqa: PLC0415  # `--help` does without

    if not _NAME.fullmatch(name):
        raise InputError(f"{name}: expected a name of small letters, digits and single _, such as acme_l5")
    if name in DEVICES or name in DEVICES.roles:
        raise InputError(f"{name}: a device kind or role has this name; expected another, such as acme_{name}")
    folder = parent / name
    if folder.exists():
        raise InputError(f"{folder}: exists; choose another name, or another place with --folder")
    try:
        parent.mkdir(parents=True, exist_ok=True)
        scratch = Path(tempfile.mkdtemp(prefix=f".{name}-", dir=parent))
        try:
            for file, text in texts(kind, name).items():
                (scratch / file).parent.mkdir(exist_ok=True)
                (scratch / file).write_text(text, encoding="utf-8")
            scratch.chmod(0o755)
            scratch.rename(folder)
        finally:
            shutil.rmtree(scratch, ignore_errors=True)
    except OSError as error:
        raise InputError(f"{parent}: {error.strerror}") from error
    return folder


def texts(kind: DriverKind, name: str) -> dict[str, str]:
    """The package's files by name."""
    words = {"name": name, "dashed": name.replace("_", "-"), "Class": name.title().replace("_", "")}
    places = {"pyproject.toml": "pyproject.toml", "kit.py": "tests/kit.py", "tests.py": f"tests/test_{name}.py"}
    found = {}
    for template in (*sorted((TEMPLATES / "common").iterdir()), *sorted((TEMPLATES / kind).iterdir())):
        file = template.name.removesuffix(".txt")
        text = Template(template.read_text(encoding="utf-8")).substitute(words)
        found[places.get(file, f"{name}_driver/{file}")] = text
    return found
