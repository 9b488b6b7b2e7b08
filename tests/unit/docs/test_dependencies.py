"""The page of dependencies has every package of ``pyproject.toml`` once, with the licence of the installed one."""

import re
import tomllib
from importlib.metadata import PackageNotFoundError, metadata
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[3]
PAGE = (ROOT / "docs" / "dependencies.md").read_text(encoding="utf-8")
ROWS = re.findall(r"^\| `([\w.-]+)` \| ([^|]+) \| ([^|]+) \|$", PAGE, re.MULTILINE)
WITHOUT_A_NAME = {"axe-playwright-python", "pyvesc-fix"}
"""Packages whose metadata name no licence, only its file."""


def test_every_package_has_its_row():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    wanted = [*project["dependencies"], *(one for extra in project["optional-dependencies"].values() for one in extra)]
    names = {found[0] for line in wanted if (found := re.match(r"[\w.-]+", line))} - {"monstertruckd"}
    assert sorted(row[0] for row in ROWS) == sorted(names)


@pytest.mark.parametrize(("name", "licence"), [row[:2] for row in ROWS if row[0] not in WITHOUT_A_NAME])
def test_the_licence_is_that_of_the_package(name: str, licence: str):
    try:
        found = metadata(name)
    except PackageNotFoundError:
        pytest.skip("not installed")
    kinds = [text for text in found.get_all("Classifier") or () if text.startswith("License")]
    stated = " ".join((found.get("License-Expression") or "", found.get("License") or "", *kinds)).casefold()
    families = {"PSF": "python software foundation", "GPL": "gpl", "LGPL": "lgpl", "MIT-CMU": "mit-cmu"}
    for each in re.split(r" or | and ", licence):
        family = families.get(each, each.partition("-")[0].casefold())
        assert family in stated, f"{name}: {stated}"
