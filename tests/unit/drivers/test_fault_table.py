"""The table of an emulator's faults: what it keeps, what it calls, what it refuses."""

import pytest

from monstertruck_drivers.fault_table import FaultTable, LateAnswers
from monstertruck_runtime.errors import InputError


def test_switches_counts_and_quantities_are_kept():
    faults = FaultTable("unit", {"silent|deaf on|off": False, "noise COUNT": 0, "torn": 0, "drift SHARE": 0.5})
    assert not faults["silent"]
    faults.start("silent", "on")
    assert (faults["silent"], faults["deaf"]) == (True, False)
    faults.start("silent", "off")
    assert not faults["silent"]
    faults.start("noise", "2")
    assert [faults.strikes("noise") for _ in range(3)] == [True, True, False]
    faults.start("torn")
    assert [faults.strikes("torn") for _ in range(2)] == [True, False]
    faults.start("drift", "0.25")
    assert faults["drift"] == 0.25


def test_functions_receive_the_values_and_switches_as_flags():
    seen: list[tuple[object, ...]] = []
    faults = FaultTable("unit", {"dead NAME on|off": lambda *values: seen.append(values)})
    faults.add({"reset": lambda: seen.append(())})
    faults.start("dead", "left", "on")
    faults.start("reset")
    assert seen == [("left", True), ()]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("explode", r"unit: unknown fault 'explode'; known: silent on\|off, noise \[COUNT\], go CODE"),
        ("silent", r"expected 'silent on\|off', got 'silent'"),
        ("silent maybe", r"expected 'silent on\|off', got 'silent maybe'"),
        ("silent on on", "expected 'silent"),
        ("noise -1", r"expected 'noise \[COUNT\]', got 'noise -1'"),
        ("go x", "expected 'go CODE', got 'go x'"),
        ("go", "expected 'go CODE', got 'go'"),
    ],
)
def test_what_does_not_fit_is_refused_with_what_was_expected(words: str, message: str):
    faults = FaultTable("unit", {"silent on|off": False, "noise [COUNT]": 0, "go CODE": lambda code: int(code)})
    with pytest.raises(InputError, match=message):
        faults.start(*words.split())


def test_the_next_answers_come_late():
    late = LateAnswers()
    late.start("0.2", "2")
    assert [late.take(0.001) for _ in range(3)] == [0.2, 0.2, 0.001]


def test_a_row_that_starts_nothing_is_named():
    with pytest.raises(InputError, match=r"ranger: fault deaf on\|off: expected a function or a number, found 'off'"):
        FaultTable("ranger", {"deaf on|off": "off"})
