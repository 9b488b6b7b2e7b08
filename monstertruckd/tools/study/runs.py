"""Open-loop runs through a daemon: circles and passes to and fro, by shaft speeds."""

import math
from collections.abc import Sequence
from contextlib import suppress
from typing import Final, NamedTuple

from monstertruck_runtime.clock import SECOND, Clock
from monstertruck_runtime.errors import InputError, NoAnswerError, RequestRefusedError, TruckError
from monstertruck_runtime.mailbox import latest
from monstertruck_runtime.presence import GONE
from monstertruck_runtime.requests import Operator
from monstertruck_schemas import topics
from monstertruckd.config.truck import TruckConfig

REVERSAL_PAUSE: Final = 0.6
"""Seconds of standstill at a reversal."""
SETTLING: Final = 2.0
"""Seconds at the beginning of a run that the analysis leaves out; they are driven besides."""


class Stretch(NamedTuple):
    """Wheel rates for a time."""

    left: float
    """Rad/s."""
    right: float
    seconds: float


def circle_plan(config: TruckConfig, ratio: float, reference: float, laps: float) -> list[Stretch]:
    """A circle to the left: the right side at the reference rate, the left one slower by the ratio.

    Args:
        config: configuration of the robot, with its geometry.
        ratio: ratio of the sides' rates, above 1; inf = the left side is locked.
        reference: rate of the faster side, rad/s.
        laps: laps of the ideal robot; one that skids turns less.

    Raises:
        InputError: numbers that make no circle.
    """
    check_circle(ratio, reference, laps)
    left = 0.0 if math.isinf(ratio) else reference / ratio
    rate = config.geometry.wheel_radius * (reference - left) / config.geometry.track
    return [Stretch(left, reference, SETTLING + laps * math.tau / rate)]


def straight_plan(config: TruckConfig, length: float, passes: int, reference: float) -> list[Stretch]:
    """Passes to and fro, each as long as the ideal robot needs.

    Args:
        config: configuration of the robot.
        length: length of a pass, m.
        passes: how many.
        reference: rate of all wheels, rad/s.

    Raises:
        InputError: numbers that make no line.
    """
    check_straight(length, passes, reference)
    seconds = length / (config.geometry.wheel_radius * reference)
    plan: list[Stretch] = []
    for i in range(passes):
        sign = -1.0 if i % 2 else 1.0
        plan += [Stretch(sign * reference, sign * reference, seconds), Stretch(0.0, 0.0, REVERSAL_PAUSE)]
    return plan


def check_circle(ratio: float, reference: float, laps: float) -> None:
    """Refuse numbers that make no circle, of any robot; arguments and error as ``circle_plan``'s."""
    if not ratio > 1.0:
        raise InputError(f"ratio {ratio:g}: expected more than 1 (2, 3, inf)")
    _require(reference, laps, "laps")


def check_straight(length: float, passes: int, reference: float) -> None:
    """Refuse numbers that make no line, of any robot; arguments and error as ``straight_plan``'s."""
    _require(reference, length, "length")
    if passes < 1:
        raise InputError(f"passes {passes}: expected at least 1")


def _require(reference: float, size: float, name: str) -> None:
    for word, value in (("reference", reference), (name, size)):
        if not 0.0 < value < math.inf:
            raise InputError(f"{word} {value:g}: expected a number above 0")


def shaft_rates(config: TruckConfig, stretch: Stretch) -> tuple[float, ...]:
    """Rates of the body's shafts.

    Raises:
        InputError: the body has no left and right side.
    """
    if config.body.kind not in ("skid_steer", "differential"):
        raise InputError(f"body {config.body.kind}: expected one with a left and a right side, such as skid_steer")
    return (stretch.left, stretch.right) * (len(config.chassis().shafts) // 2)


async def drive(robot: Operator, clock: Clock, config: TruckConfig, plan: Sequence[Stretch]) -> float:
    """Arm, drive a plan, disarm.

    Returns:
        Seconds it took.

    Raises:
        RequestRefusedError: arming was refused; or the robot stopped on the way, with the gate's reason.
        NoAnswerError: it has been silent for ``GONE`` s.
        InputError: the body has no sides, or is too slow for the requested rates.
    """
    plan = (*plan, Stretch(0.0, 0.0, REVERSAL_PAUSE))  # at rest before it is disarmed
    rates = [shaft_rates(config, stretch) for stretch in plan]
    fastest = max(max(map(abs, row)) for row in rates) * config.geometry.wheel_radius
    if fastest > config.gate.speed:
        raise InputError(f"{fastest:.3f} m/s at the wheels: expected at most gate.speed, {config.gate.speed:g}")
    began = clock.now()
    with robot.subscribe(topics.GATE, latest()) as gate:
        armed = await robot.arm(hold=True)  # a planner would drive until the first request arrives
        seen, heard = armed, clock.now()
        try:
            for stretch, row in zip(plan, rates, strict=True):
                due = clock.now()
                end = due + round(stretch.seconds * SECOND)
                while due < end:
                    await robot.drive_shafts(*row, lease=0.25)
                    due += round(0.05 * SECOND)  # seconds between two requests
                    await clock.sleep_until(min(due, end))
                    state = gate.latest
                    if state is not None and state is not seen:
                        seen, heard = state, clock.now()
                    if not seen.mode.active and seen.stamp > armed.stamp:
                        raise RequestRefusedError(seen.worst, f"the robot stopped during the run: {seen.why}")
                    if clock.now() - heard > GONE * SECOND:
                        raise NoAnswerError(f"the robot has been silent for {GONE:g} s")
        except BaseException:
            with suppress(TruckError):  # report the cause of the run's end
                await robot.disarm()
            raise
        await robot.disarm()
    return (clock.now() - began) / SECOND
