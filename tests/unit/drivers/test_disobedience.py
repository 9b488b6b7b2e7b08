"""What an emulated controller that disobeys makes of its targets."""

import pytest

from monstertruck_drivers.disobedience import Disobedience, DisobedientMotor, StoppedBy


@pytest.mark.parametrize(
    ("words", "asked", "present", "target"),
    [
        ("ignore", 0.0, 500.0, 500.0),
        ("ignore", 400.0, 500.0, 500.0),
        ("ignore", 600.0, 500.0, 600.0),
        ("ignore", -600.0, 500.0, 500.0),
        ("creep -80", 0.0, 0.0, -80.0),
        ("creep 80", 100.0, 0.0, 100.0),
        ("run 900", -100.0, 0.0, 900.0),
        ("reverse", 300.0, 0.0, -300.0),
        ("ignore", None, 500.0, None),
        ("ignore line", None, 500.0, 500.0),
    ],
)
def test_a_controller_makes_of_its_target_what_its_fault_says(
    words: str, asked: float | None, present: float, target: float | None
):
    runaway = DisobedientMotor.parse(*words.split())
    assert runaway is not None
    assert runaway.target(asked, present) == target


@pytest.mark.parametrize(
    ("stopped_by", "line", "stops"),
    [("stage", False, True), ("line", False, False), ("line", True, True), ("supply", True, False)],
)
def test_each_way_to_stop_it_works_from_the_one_named_on(stopped_by: str, line: bool, stops: bool):
    runaway = DisobedientMotor(Disobedience.RUN, 900.0, StoppedBy(stopped_by))
    assert (runaway.target(None, 900.0, line=line) is None) is stops


def test_off_is_no_fault_and_anything_else_unknown_is_refused():
    assert DisobedientMotor.parse("off") is None
    for words in ("creep", "run 0", "ignore stage more", "walk", ""):
        with pytest.raises(ValueError, match=words.split(" ")[0] or "''"):
            DisobedientMotor.parse(*words.split(" "))
