"""Plans of the study's runs, and the paper's table beside them."""

import math
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from pydantic import ValidationError

from monstertruck_runtime.clock import SECOND, VirtualClock, run_virtual
from monstertruck_runtime.errors import InputError, TruckError
from monstertruck_runtime.mailbox import Mailbox, latest
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.state import GateMode, GateState
from monstertruckd.tools.simulation.config import load_simulated
from monstertruckd.tools.study import published
from monstertruckd.tools.study.runs import CircleRun, StraightRun, Stretch, drive, shaft_rates
from tests.bus_kit import gate_state

CONFIGS = Path(__file__).resolve().parents[4] / "configs"
STAND = load_simulated(CONFIGS / "robots" / "skid_stand.yaml")


def test_a_circle_has_the_faster_side_at_the_reference():
    (stretch,) = CircleRun(ratio=2.0, reference=1.57, laps=5.0).plan(STAND)
    assert (stretch.left, stretch.right) == (0.785, 1.57)
    assert stretch.seconds == pytest.approx(2.0 + 5 * math.tau / (0.021 * 0.785 / 0.105))
    assert shaft_rates(STAND, stretch) == (0.785, 1.57, 0.785, 1.57)
    assert CircleRun(ratio=math.inf, laps=1.0).plan(STAND)[0].left == 0.0


def test_a_line_goes_to_and_fro():
    plan = StraightRun(length=0.682, passes=3, reference=1.57).plan(STAND)
    assert [stretch.left for stretch in plan] == [1.57, 0.0, -1.57, 0.0, 1.57, 0.0]
    assert plan[0].seconds == pytest.approx(0.682 / (0.021 * 1.57))


class Stopping:
    """A robot whose gate disarms it, or that vanishes, in the second second; its computer began at another time."""

    def __init__(self, clock: VirtualClock, offset: float, *, vanishes: bool) -> None:
        self._clock, self._offset, self._vanishes = clock, round(offset * SECOND), vanishes
        self._box: Mailbox[GateState] = Mailbox(latest())
        self._mode = GateMode.DISARMED
        self._box.put(self._state())

    def _state(self) -> GateState:
        held = (Reason.SCAN_STALE,) if self._mode is GateMode.DISARMED else ()
        state = gate_state(0, reasons=held)
        return state.model_copy(update={"stamp": self._clock.now() + self._offset, "mode": self._mode})

    @contextmanager
    def subscribe(self, *_: object) -> Iterator[Mailbox[GateState]]:
        yield self._box

    async def arm(self, *, hold: bool) -> GateState:
        assert hold, "a planner would drive until the first request arrives"
        self._mode, self._armed = GateMode.DRIVING, self._clock.now()
        await self._clock.sleep(0.02)
        return self._state()

    async def disarm(self) -> None:
        pass

    async def drive_shafts(self, *_: float, lease: float) -> None:
        late = self._clock.now() - self._armed > SECOND
        if late:
            self._mode = GateMode.DISARMED
        if not (late and self._vanishes):
            self._box.put(self._state())


@pytest.mark.parametrize("offset", [-1e6, 0.0, 1e6])
@pytest.mark.parametrize(
    ("vanishes", "said"),
    [(False, "the robot stopped during the run: no fresh lidar scan"), (True, "the robot has been silent for 2 s")],
)
def test_a_robot_that_stops_or_vanishes_ends_the_run_whenever_its_computer_was_started(
    offset: float, vanishes: bool, said: str
):
    async def main(clock: VirtualClock) -> float:
        with pytest.raises(TruckError, match=said):
            await drive(Stopping(clock, offset, vanishes=vanishes), clock, STAND, [Stretch(1.0, 1.0, 20.0)])
        return clock.now() / SECOND

    took = run_virtual(main, start=0)
    assert took == pytest.approx(1.1 + 2.0 * vanishes, abs=0.2)


@pytest.mark.parametrize("numbers", [(1.0, 1.57, 1.0), (math.nan, 1.0, 1.0), (2.0, 0.0, 1.0), (2.0, 1.0, math.inf)])
def test_numbers_that_make_no_circle(numbers):
    with pytest.raises(ValidationError):
        CircleRun(**dict(zip(("ratio", "reference", "laps"), numbers, strict=True)))


@pytest.mark.parametrize("numbers", [(0.0, 1, 1.0), (1.0, 0, 1.0), (1.0, 1, -1.0)])
def test_numbers_that_make_no_line(numbers):
    with pytest.raises(ValidationError):
        StraightRun(**dict(zip(("length", "passes", "reference"), numbers, strict=True)))


def test_a_truck_has_no_sides():
    truck = load_simulated(CONFIGS / "demo.yaml")
    with pytest.raises(InputError, match="expected one with a left and a right side"):
        shaft_rates(truck, CircleRun().plan(STAND)[0])


def test_the_paper_contradicts_itself_where_we_say_so():
    for row in published.CIRCLES:
        circle = row.measured
        ideal = 0.021 * (circle.left + circle.right) / 2
        if row.recomputed_deviation is not None:
            assert 100 * (circle.speed / ideal - 1) == pytest.approx(row.recomputed_deviation, abs=0.1)
            assert ("speed" in row.slip) == (abs(row.recomputed_deviation - row.speed_deviation) > 0.5)
        if row.drift is not None:
            assert ("drift" in row.slip) == (abs(math.hypot(*row.drift) - row.drift_speed) > 5e-6)


def test_published_circles_are_found_by_their_rates_whichever_side_is_faster():
    row = published.nearest(0.785, 1.57)
    assert row is not None
    assert row is published.nearest(1.57, 0.785)
    assert row.measured.label == "2:1, 1.57 rad/s"
    assert published.nearest(0.5, 0.9) is None
