"""The files of the folder ``systemd``, beside the packages in a checkout and inside this one in an installation."""

import re
from pathlib import Path
from typing import Final

from monstertruck_runtime.errors import NotFoundError

_PACKAGE: Final = Path(__file__).resolve().parents[2]
PLACES: Final = (_PACKAGE / "systemd", _PACKAGE.parent / "systemd")


def shipped(name: str) -> Path:
    """Where a file of the folder is.

    Raises:
        NotFoundError: the installation is not whole.
    """
    for place in PLACES:
        if (place / name).is_file():
            return place / name
    raise NotFoundError(f"{name} is missing from the installation; looked in {' and '.join(map(str, PLACES))}")


def filled(name: str, values: dict[str, str]) -> str:
    """Text of a shipped file, its ``@names@`` replaced; a line of its own vanishes if its value is empty."""

    def value(match: re.Match[str]) -> str:
        return values[match["name"]]

    text = shipped(name).read_text(encoding="utf-8")
    empty = [key for key, replacement in values.items() if not replacement]
    for key in empty:
        text = text.replace(f"@{key}@\n", "")
    return re.sub(r"@(?P<name>[a-z]+)@", value, text)
