"""Every fault of the catalogue is found with its mend, and a healthy computer has none."""

from pathlib import Path

import pytest

from tests.unit.tools.doctor.catalogue import FAULTS, Fault, examined, log, mistakes, together, weaving


def test_the_catalogue_is_long_and_its_names_differ():
    assert len({fault.name for fault in FAULTS}) == len(FAULTS) >= 40


@pytest.mark.parametrize("faults", together(), ids=lambda faults: faults[0].name)
def test_they_are_found_with_their_mends(faults: list[Fault], tmp_path: Path):
    assert mistakes(examined(tmp_path, faults), faults) == []


def test_a_healthy_computer_that_drove_has_none(tmp_path: Path):
    assert mistakes(examined(tmp_path, [], log(*weaving())), []) == []
