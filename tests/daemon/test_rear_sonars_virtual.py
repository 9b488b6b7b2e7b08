"""The shipped truck with sonars that look backwards, through real drivers and emulators, on the virtual clock."""

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import pytest

from monstertruck_runtime.clock import SECOND, VirtualClock, run_virtual
from monstertruck_runtime.mailbox import fifo
from monstertruck_schemas import topics
from monstertruck_schemas.reasons import Reason
from monstertruck_sim.world.obstacles import Disc
from monstertruckd.config.load import load_config
from monstertruckd.tools.simulation.config import SimulatedTruckConfig, with_overlay
from monstertruckd.tools.simulation.virtual_rig import VirtualRig
from tests.calibration_kit import LocalTruck

pytestmark = [pytest.mark.virtual, pytest.mark.timeout(120)]

ROBOT = Path(__file__).resolve().parents[2] / "configs" / "robots" / "truck_rear_sonars.yaml"
TAIL = 0.235
"""Distance of the tail behind the base, m."""
WALL = -3.5
"""x of a wall of the yard, m."""
STEP = 0.1
"""Seconds between two requests."""


class Reversed(NamedTuple):
    """What came of a drive in reverse."""

    rooms: list[float]
    """Distance between tail and wall at every request, m."""
    reasons: list[set[Reason]]
    """Reasons of the gate between requests."""

    @property
    def driven(self) -> float:
        return self.rooms[0] - self.rooms[-1]


def reverse(
    room: float,
    *,
    sonars: bool = True,
    seconds: float = 12.0,
    happen: Callable[[VirtualRig, VirtualClock, int], None] = lambda rig, clock, step: None,
) -> Reversed:
    """Ask for 0.15 m/s in reverse, ``room`` metres before a wall; ``happen`` is called at every request."""
    overlay = {
        "recorder": None,
        "path": None,
        "tracker": None,
        "odometry": {"start": {"x": 0.0, "y": 0.0, "yaw": 0.0}},
        "sim": {"world": {"map": "yard", "start": {"x": WALL + TAIL + room, "y": 0.0, "yaw": 0.0}}},
    }
    if not sonars:
        overlay["devices"] = {"sonar": None}
    config = with_overlay(load_config(ROBOT, SimulatedTruckConfig)[0], overlay)

    async def main(clock: VirtualClock) -> Reversed:
        rig = VirtualRig(config, clock)
        with rig.bus.subscribe(topics.GATE, fifo(4096)) as gate:
            async with rig.running():
                await clock.sleep(3.0)
                truck = LocalTruck(rig.daemon, clock)
                await truck.arm()
                gate.drain()
                rooms, reasons = [], []
                for step in range(round(seconds / STEP)):
                    happen(rig, clock, step)
                    await truck.drive(-0.15, 0.0, 0.0)
                    await clock.sleep(STEP)
                    rooms.append(rig.world.truth(clock.now()).x - WALL - TAIL)
                    reasons.append({reason for state in gate.drain() for reason in state.reasons})
                assert not rig.truth.array()[:, 5].any(), "touched"
                return Reversed(rooms, reasons)

    return run_virtual(main, start=SECOND)


def test_it_reverses_to_a_wall_that_its_sonars_measure():
    done = reverse(1.0, seconds=10.0)
    assert done.driven > 0.8
    assert 0.03 < done.rooms[-1] < 0.15
    assert done.reasons[-1] & {Reason.UNSEEN_STOP, Reason.OBSTACLE_STOP}


def silence(at: float) -> Callable[[VirtualRig, VirtualClock, int], None]:
    """All sonars fall silent ``at`` s after the first request."""

    def happen(rig: VirtualRig, clock: VirtualClock, step: int) -> None:
        if step == round(at / STEP):
            rig.robot.emulators["sonar"].inject("silent", "on")

    return happen


@pytest.mark.parametrize("without", [{"sonars": False}, {"happen": silence(0.0)}])
def test_without_an_answer_it_stands(without):
    done = reverse(1.0, seconds=4.0, **without)
    assert done.driven < 0.1
    assert Reason.UNSEEN_STOP in done.reasons[-1]


def test_it_stops_when_its_sonars_fall_silent():
    done = reverse(1.5, seconds=6.0, happen=silence(3.0))
    assert 0.2 < done.driven < 0.6
    assert done.rooms[-1] > 0.8
    assert Reason.UNSEEN_STOP in done.reasons[-1]


@pytest.mark.parametrize(("behind", "side"), [(0.3, -1), pytest.param(0.5, 1, marks=pytest.mark.long)])
def test_it_waits_for_a_person_who_walks_in_behind_it(behind: float, side: int):
    """A person comes from beside the truck, ``behind`` m behind its tail, stands there for 4 s and walks on."""
    begins, pace, radius = 2.0, 0.8, 0.15
    seen = [Disc(0.0, 0.0, radius)]

    def happen(rig: VirtualRig, clock: VirtualClock, step: int) -> None:
        walked = step * STEP - begins
        if walked < 0:
            return
        if walked == 0:
            seen[0] = Disc(rig.world.truth(clock.now()).x - TAIL - behind - radius, 1.2 * side, radius)
        else:
            rig.world.remove(clock.now(), seen[0])
        arrives, leaves = 1.2 / pace, 1.2 / pace + 4.0
        y = 1.2 - pace * min(walked, arrives) - pace * max(walked - leaves, 0.0)
        seen[0] = Disc(seen[0].x, side * y, radius)
        rig.world.add(clock.now(), seen[0])

    done = reverse(2.0, seconds=12.0, happen=happen)
    stands = [room for step, room in enumerate(done.rooms) if 5.5 <= step * STEP <= 7.0]
    assert stands[0] - stands[-1] < 0.005, "it drives at the person"
    assert Reason.OBSTACLE_STOP in set().union(*done.reasons)
    assert stands[-1] - done.rooms[-1] > 0.2, "it does not go on"
