"""Turns per metre of single runs, and how runs are judged."""

import asyncio
import math
from types import SimpleNamespace

import pytest

from monstertruck_runtime.clock import SECOND
from monstertruck_runtime.errors import InputError
from monstertruck_schemas.sensor import Attitude, DriveFeedback, DriveMode
from monstertruckd.tools.calibrate.drive import DriveWizard, TapedRun, arc
from monstertruckd.tools.calibrate.steps import MoveRecord


def track(turns: float, turn: float = 0.0) -> MoveRecord:
    """A run with a second of rest at both ends."""

    def drive(second: float, position: float) -> DriveFeedback:
        stamp = round(second * SECOND)
        return DriveFeedback(
            stamp=stamp, received=stamp, seq=0, position=position, velocity=0.0, mode=DriveMode.ENABLED, current=0.1
        )

    def compass(second: float, heading: float) -> Attitude:
        stamp = round(second * SECOND)
        return Attitude(stamp=stamp, received=stamp, seq=0, heading=heading % (2 * math.pi), roll=0.0, pitch=0.0)

    angle = 2 * math.pi * turns
    before = [compass(i / 20, 0.1 + 0.001 * (i % 2)) for i in range(20)]
    moving = [compass(1 + i / 20, 0.1 - turn * i / 80) for i in range(80)]
    after = [compass(5.05 + i / 20, 0.1 - turn + 0.001 * (i % 2)) for i in range(20)]
    return MoveRecord(
        drive=[drive(0, 0.0), drive(1, 0.0), drive(5, angle), drive(6, angle)],
        attitude=[*before, *moving, *after],
        left=SECOND,
        arrived=5 * SECOND,
    )


def test_a_straight_run():
    run = TapedRun.of(track(2732.0), 2.0)
    assert run.turns / run.length == pytest.approx(1366.0, rel=1e-5)
    assert TapedRun.of(track(-2732.0), 2.0).turns == pytest.approx(2732.0)


def test_the_tape_measures_the_chord_of_a_bend():
    radius, turn = 8.0, 0.25
    run = TapedRun.of(track(2732.0, turn), 2 * radius * math.sin(turn / 2))
    assert run.length == pytest.approx(radius * turn, rel=1e-4)
    assert run.bend == pytest.approx(turn**2 / 24, rel=0.02)
    assert arc(2.0, 0.0) == 2.0


def test_a_crooked_run_measures_nothing():
    with pytest.raises(InputError, match=r"turned by 29 deg during the run: run `calibrate steering --rough` first"):
        TapedRun.of(track(2732.0, 0.5), 2.0)


def test_no_headings_at_rest():
    short = track(2732.0)
    short.attitude = short.attitude[:-18]
    with pytest.raises(InputError, match="20 and 2 compass headings at rest: expected 5"):
        TapedRun.of(short, 2.0)


class Course:
    """A context in which every run has the same turns of the motor and the same taped distance."""

    known: dict[str, object] = {}
    values = {"geometry.wheel_radius": 0.075, "devices.drive.driver.inverted": False, "devices.drive.driver.rate": 50}

    def __init__(self, move: MoveRecord, compass: object) -> None:
        self._move = move
        self.config = SimpleNamespace(devices=SimpleNamespace(compass=compass, drive=None))
        self.asked: list[str] = []
        self.said: list[str] = []
        self.value = self.values.__getitem__
        self.say = self.said.append
        self.plot = lambda plot: None

    async def confirm(self, step):
        self.asked.append(step.name)
        return True

    async def ask(self, step):
        self.asked.append(step.name)
        return 2.0

    async def move(self, _step):
        return self._move

    def fit(self, name, function):
        return [] if name == "dead time and lag" else function()


def test_without_a_compass_the_operator_judges_the_bend_and_the_result_says_so():
    move = track(2732.0)
    move.attitude.clear()
    course = Course(move, None)
    result = asyncio.run(DriveWizard(runs=3)(course))
    assert course.asked == ["clear", "forward", *["mark", "distance", "straight"] * 3]
    assert len(course.said) == 1
    turns = result.estimate("turns_per_metre")
    assert turns.low < 2732.0 / (2.0 * 1.0051) < 2732.0 / 2.0 < turns.high
    assert "0.26% for curved runs" in turns.meaning


def test_without_a_compass_a_run_that_looks_crooked_measures_nothing():
    with pytest.raises(InputError, match="more than 20 deg during the run: set the centre of its servos"):
        TapedRun.of(track(2732.0), 2.0, straight=False)


def test_a_silent_compass_is_noticed_before_anything_is_taped():
    move = track(2732.0)
    move.attitude.clear()
    course = Course(move, object())
    with pytest.raises(InputError, match="only 0 and 0 compass headings at rest"):
        asyncio.run(DriveWizard()(course))
    assert course.asked == ["clear", "forward"]
