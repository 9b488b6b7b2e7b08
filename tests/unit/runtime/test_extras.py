"""Extras of the distribution and the command that installs what is missing."""

import pytest

from monstertruck_runtime import extras
from monstertruck_runtime.extras import Requirement, not_installed, pip_command, required

LINES = [
    "numpy>=2.0",
    'mcap>=1.3; extra == "robot"',
    "monstertruckd[robot]; extra == 'sim'",
    "numba (>=0.61) ; extra == 'sim'",
    "ompl>=1.7; python_version < '3.14' and extra == 'bench'",
    "coverage[toml]>=7.6; extra == 'dev'",
]


def test_a_requirement_has_a_name_versions_and_the_extra_that_names_it():
    assert Requirement.parse(LINES[0]) == ("numpy", (), ">=2.0", "")
    assert Requirement.parse(LINES[3]) == ("numba", (), ">=0.61", "sim")
    assert Requirement.parse(LINES[4]) == ("ompl", (), ">=1.7", "bench")
    assert Requirement.parse(LINES[5]) == ("coverage", ("toml",), ">=7.6", "dev")
    assert Requirement.parse("kiss-icp") == ("kiss-icp", (), "", "")
    with pytest.raises(ValueError, match="expected a name"):
        Requirement.parse("; extra == 'sim'")


def test_an_extra_brings_what_the_extras_in_it_bring():
    assert [row.name for row in required("sim", LINES)] == ["mcap", "numba"]
    assert [row.name for row in required("", LINES)] == ["numpy"]


def test_the_command_names_packages_that_an_index_has_never_the_distribution(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(extras, "checkout", lambda: None)
    monkeypatch.setattr(extras.metadata, "requires", lambda _: LINES)
    monkeypatch.setattr(extras, "_installed", lambda name: name == "mcap")
    text = str(not_installed("points: opencv", "sim"))
    assert text.startswith("points: opencv is not installed; the extra 'sim' contains it: ")
    assert text.endswith(" -m pip install 'numba>=0.61'")
    assert pip_command("/my env/python", [Requirement.parse("a>=1")]) == "'/my env/python' -m pip install 'a>=1'"


def test_in_a_checkout_the_lock_file_is_installed():
    folder = extras.checkout()
    assert folder is not None
    assert str(not_installed("x", "sim")).endswith(f"cd {folder} && python3 -m monstertruckd.bootstrap sync")


def test_nothing_lacks_what_is_required_always():
    assert extras.lacking("") == []
