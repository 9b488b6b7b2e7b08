"""Maps and state of a robot through kills and power cuts; ``benchmarks/durability.py`` does more of them."""

import shutil
from pathlib import Path

import pytest

from benchmarks.durability_parts import maps, state
from benchmarks.durability_parts.deaths import cuts, kills
from benchmarks.durability_parts.subject import Subject
from tests.long_kit import mostly_long

SUBJECTS = {subject.name: subject for subject in (maps.SUBJECT, *state.SUBJECTS)}


@pytest.mark.parametrize("name", mostly_long(SUBJECTS, {"maps", "latch"}))
def test_nothing_acknowledged_is_lost_by_a_power_cut_and_nothing_is_mixed(tmp_path: Path, name: str):
    """The others write as the latch does."""
    if shutil.which("cc") is None:
        pytest.skip("there is no C compiler")
    assert cuts([SUBJECTS[name]], 6, 3, tmp_path) == {name: {"cuts": 6, "faults": 0}}


@pytest.mark.parametrize("subject", SUBJECTS.values(), ids=SUBJECTS)
def test_nothing_acknowledged_is_lost_by_a_kill_and_nothing_is_mixed(tmp_path: Path, subject: Subject):
    assert kills([subject], 3, 5, tmp_path) == {subject.name: {"kills": 3, "faults": 0}}
