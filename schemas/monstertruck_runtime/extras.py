"""Extras of the distribution: their packages, and the command that installs missing ones.

The distribution itself is not in a package index, so a command names the packages of an extra.
"""

import json
import re
import shlex
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from importlib import metadata
from typing import Final, NamedTuple
from urllib.parse import unquote, urlparse

from monstertruck_runtime.errors import NotInstalledError

DISTRIBUTION: Final = "monstertruckd"


class Requirement(NamedTuple):
    """One line of a distribution's metadata."""

    name: str
    inner: tuple[str, ...]
    """Extras of the required distribution."""
    versions: str
    """Version specifier such as ``>=1.3``; empty for any version."""
    extra: str
    """Extra that requires it; empty if it is always required."""

    @classmethod
    def parse(cls, line: str) -> "Requirement":
        """Parse a requirement (PEP 508, without a URL).

        Raises:
            ValueError: it does not start with a name.
        """
        found = re.match(r"\s*([\w.-]+)\s*(?:\[([^]]*)\])?\s*\(?([^;()]*)\)?", line)
        if found is None:
            raise ValueError(f"requirement {line!r}: expected a name")
        extra = re.search(r"extra\s*==\s*['\"]([\w-]+)['\"]", line)
        inner = tuple(part.strip() for part in (found[2] or "").split(",") if part.strip())
        return cls(found[1], inner, found[3].strip(), "" if extra is None else extra[1])


def required(extra: str, lines: Sequence[str]) -> Iterator[Requirement]:
    """Requirements of an extra in a distribution's metadata, including nested extras."""
    for line in lines:
        requirement = Requirement.parse(line)
        if requirement.extra != extra:
            continue
        if requirement.name == DISTRIBUTION:
            for inner in requirement.inner:
                yield from required(inner, lines)
        else:
            yield requirement


def lacking(extra: str) -> list[Requirement]:
    """Requirements of an extra without an installed version."""
    return [row for row in required(extra, metadata.requires(DISTRIBUTION) or ()) if not _installed(row.name)]


def _installed(name: str) -> bool:
    try:
        metadata.version(name)
    except metadata.PackageNotFoundError:
        return False
    return True


def pip_command(python: str, requirements: Sequence[Requirement]) -> str:
    """The command that installs packages from an index."""
    return shlex.join([python, "-m", "pip", "install", *(row.name + row.versions for row in requirements)])


def checkout() -> str | None:
    """Folder of the running checkout; None if the program runs from an installed wheel."""
    try:
        origin = metadata.distribution(DISTRIBUTION).read_text("direct_url.json")
    except metadata.PackageNotFoundError:
        return None
    facts = json.loads(origin or "{}")
    return unquote(urlparse(facts["url"]).path) if facts.get("dir_info", {}).get("editable") else None


def not_installed(what: str, extra: str) -> NotInstalledError:
    """Error of a missing library: its name, its extra, and the command that installs it."""
    folder = checkout()
    if folder is not None:
        command = f"cd {shlex.quote(folder)} && python3 -m monstertruckd.bootstrap sync"
    else:
        command = pip_command(sys.executable, lacking(extra))
    return NotInstalledError(f"{what} is not installed; the extra {extra!r} contains it: {command}")


@contextmanager
def needs_extra(name: str) -> Iterator[None]:
    """Name the extra of the distribution that contains a missing library.

    Raises:
        NotInstalledError: an import inside failed.
    """
    try:
        yield
    except ModuleNotFoundError as error:
        if error.name is None or error.name.startswith("monstertruck"):
            raise
        raise not_installed(error.name, name) from None
