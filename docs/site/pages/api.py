"""Python API reference: the names that the pages, their examples and the packages of ``new-driver`` import."""

import importlib
import json
import re
from collections.abc import Iterator, Sequence
from itertools import groupby
from pathlib import Path

from pages.markdown import Page, join, prose, table

ROOT = Path(__file__).resolve().parents[3]
SOURCES = (
    "README.md",
    "docs/*.md",
    "docs/examples/**/*.py",
    "docs/notebooks/*.ipynb",
    "monstertruckd/tools/new_driver/templates/**/*.py.txt",
)
"""What users read and copy; what they import is public."""
CLIENT = {"monstertruckd": ["open_log"]}
"""What [versions](../versions.md) promises beside it."""
IMPORT = re.compile(r"^ *from (monstertruck[\w.]*) import (?:\(([^)]*)\)|([^\n#]+))", re.MULTILINE)


def used() -> dict[str, list[str]]:
    """Public names by their module, both in order."""
    found = {module: set(names) for module, names in CLIENT.items()}
    for text in _texts():
        for module, several, one in IMPORT.findall(text):
            names = re.split(r"[,\s]+", re.sub(r"#.*", "", several) or one)
            found.setdefault(module, set()).update(name for name in names if name.isidentifier())
    return {module: sorted(names) for module, names in sorted(found.items())}


def pages() -> list[Page]:
    """Return an index and a page for each package."""
    modules = used()
    packages = {package: list(of) for package, of in groupby(modules, lambda module: module.partition(".")[0])}
    index = join(
        "# Python API",
        "The names that drivers, trackers, planners, robot bodies, gate checks and programs on a ground station "
        "import. They follow the promise of [versions](../versions.md); every other name is internal.",
        table(
            ("module", "names"),
            (
                (f"[{module}]({package}.md#{module})", ", ".join(f"`{name}`" for name in modules[module]))
                for package, of in packages.items()
                for module in of
            ),
        ),
    )
    return [
        Page("api/index.md", "Python API", index),
        *(
            Page(
                f"api/{package}.md",
                package,
                join(f"# {package}", _purpose(package), *(_section(module, modules[module]) for module in of)),
            )
            for package, of in packages.items()
        ),
    ]


def _purpose(package: str) -> str:
    return prose(importlib.import_module(package).__doc__)


def _section(module: str, names: Sequence[str]) -> str:
    return join(f"## {module} {{ #{module} }}", *(f"::: {module}.{name}" for name in names))


def _texts() -> Iterator[str]:
    for pattern in SOURCES:
        for file in sorted(ROOT.glob(pattern)):
            text = file.read_text(encoding="utf-8")
            if file.suffix == ".ipynb":
                yield from ("".join(cell["source"]) for cell in json.loads(text)["cells"])
            else:
                yield text
