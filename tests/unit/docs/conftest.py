"""Modules of the documentation's site, which are no package of the program."""

import importlib
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType

import pytest

SITE = Path(__file__).resolve().parents[3] / "docs" / "site"


@pytest.fixture
def site_module(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[str], ModuleType]]:
    """Import a module of the site's pages by name; it is forgotten after the test."""
    monkeypatch.syspath_prepend(str(SITE))
    yield lambda name: importlib.import_module(f"pages.{name}")
    for name in [name for name in sys.modules if name == "pages" or name.startswith("pages.")]:
        del sys.modules[name]
