"""Files that are installed with the modules: configurations, and what the service needs."""

import difflib
from collections.abc import Iterator
from pathlib import Path
from typing import Final

from monstertruck_runtime.errors import ConfigError

_PACKAGE: Final = Path(__file__).resolve().parents[1]
PLACES: Final = (_PACKAGE, _PACKAGE.parent)
"""Folders of an installed wheel, and of a checkout."""
CONFIGS: Final = "configs"
GROUPS: Final = ("", "robots/")
"""Folders in ``configs`` whose files a name finds without its folder, in this order."""


def shipped(name: str) -> Path:
    """Where a file or folder is, e.g. ``configs/demo.yaml``; below the last place if it is in none."""
    return next((place / name for place in PLACES if (place / name).exists()), PLACES[-1] / name)


def configuration(given: Path) -> Path:
    """The file of a configuration: the given one, or the bundled one of that name.

    Args:
        given: file; else a bundled configuration such as ``goals``, ``mecanum``, ``robots/mecanum`` or
            ``configs/goals.yaml``. A name that is absolute or ends in ``.yaml`` is returned as it is, also if
            there is no such file.

    Raises:
        ConfigError: neither a file nor the name of a bundled configuration.
    """
    if given.is_file():
        return given
    if given.suffix == ".yaml":
        bundled = shipped(str(given))
        return bundled if given.parts[0] == CONFIGS and bundled.is_file() else given
    if given.is_absolute() or not given.parts:
        return given
    for group in GROUPS:
        if (found := shipped(f"{CONFIGS}/{group}{given}.yaml")).is_file():
            return found
    if given.exists():
        return given
    known = list(names())
    near = difflib.get_close_matches(str(given), known, n=1)
    expected = f"did you mean {near[0]!r}?" if near else f"expected a file or one of {', '.join(known)}"
    raise ConfigError(f"{given}: neither a file nor a bundled configuration; {expected}")


def names() -> Iterator[str]:
    """Names of the bundled configurations of robots, in the order of ``GROUPS``."""
    for group in GROUPS:
        for file in sorted(shipped(f"{CONFIGS}/{group}").glob("*.yaml")):
            yield group + file.stem
