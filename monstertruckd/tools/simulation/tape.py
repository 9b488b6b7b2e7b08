"""Tape, string and meter for an emulated robot, for its manual calibration."""

import math
from collections.abc import Callable
from typing import Final

from monstertruck_kinematics.se2 import to_body, to_world
from monstertruck_runtime.clock import Clock
from monstertruck_runtime.errors import InputError
from monstertruck_sim.world.plant import TruthState
from monstertruck_sim.world.world import World

WORDS: Final = (
    "tape mark (mark the floor below the front bumper and lay a string along the robot), tape (measure "
    "from there, and read the pack voltage)"
)


class EmulatedTape:
    """Measures the simulated truth for a person; the robot receives nothing.

    Args:
        world: world with the robot.
        clock: source of time.
        body: length and width of the robot (m).
        say: receives measurements, one per line.
    """

    def __init__(self, world: World, clock: Clock, body: tuple[float, float], say: Callable[[str], None]) -> None:
        self._world, self._clock, self._body, self._say = world, clock, body, say
        self._mark: TruthState | None = None

    def command(self, words: list[str]) -> None:
        """Execute ``mark``, or measure from the mark; without a mark, measure distances that need none.

        Raises:
            InputError: another word.
        """
        now = self._world.truth(self._clock.now())
        if words == ["mark"]:
            self._mark = now
        elif words:
            raise InputError(f"expected {WORDS}")
        elif self._mark is None:
            self._say(f"{_meter(now)}; type `tape mark` first to measure a distance")
        else:
            self._say(measured(self._mark, now, *self._body))


def measured(mark: TruthState, now: TruthState, length: float, width: float) -> str:
    """Return the readings of tape, string and meter.

    Args:
        mark: state when mark and string were laid.
        now: state at the measurement.
        length: length of the body (m).
        width: width of the body (m).
    """
    (ahead, left), (_, side) = (_moved(mark, now, *place) for place in ((length / 2, 0.0), (0.0, width / 2)))
    turn = math.degrees(math.remainder(now.yaw - mark.yaw, math.tau))
    return (
        f"front bumper {math.hypot(ahead, left):.3f} m from its mark: {100 * ahead:.1f} cm ahead, {100 * left:.1f} cm "
        f"left; middle of the left side {100 * side:.1f} cm left of the string; turned {turn:.1f} deg to the left; "
        f"{_meter(now)}"
    )


def _meter(now: TruthState) -> str:
    return f"pack {now.supply_v:.2f} V"


def _moved(mark: TruthState, now: TruthState, x: float, y: float) -> tuple[float, float]:
    """Return the displacement of a point of the body, ahead and left, m; x and y from the body's centre (m)."""
    ahead, left = to_body(mark.yaw, now.x - mark.x, now.y - mark.y)
    now_x, now_y = to_world(now.yaw - mark.yaw, x, y)
    return ahead + now_x - x, left + now_y - y
