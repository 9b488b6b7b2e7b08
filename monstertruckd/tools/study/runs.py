"""Open-loop runs through a daemon: circles and passes to and fro, by shaft speeds."""

import math
from collections.abc import Sequence
from contextlib import suppress
from typing import Annotated, Final, NamedTuple

from pydantic import Field

from monstertruck_runtime.clock import SECOND, Clock
from monstertruck_runtime.errors import InputError, NoAnswerError, RequestRefusedError, TruckError
from monstertruck_runtime.mailbox import latest
from monstertruck_runtime.presence import GONE
from monstertruck_runtime.requests import Operator
from monstertruck_schemas import topics
from monstertruck_schemas.base import Schema
from monstertruckd.config.truck import TruckConfig

REVERSAL_PAUSE: Final = 0.6
"""Seconds of standstill at a reversal."""
SETTLING: Final = 2.0
"""Seconds at the beginning of a run that the analysis leaves out; they are driven besides."""


Positive = Annotated[float, Field(gt=0)]


class Stretch(NamedTuple):
    """Wheel rates for a time."""

    left: float
    """Rad/s."""
    right: float
    seconds: float


class CircleRun(Schema):
    """A circle to the left: the right side at the reference rate, the left one slower by the ratio."""

    ratio: Annotated[float, Field(gt=1, allow_inf_nan=True)] = 2.0
    """Ratio of the wheel rates: 2, 3, or inf (left side locked)"""
    reference: Positive = 1.57
    """Rate of the faster side's wheels, rad/s"""
    laps: Positive = 5.0
    """Laps of the ideal robot; a robot that skids turns less"""

    def plan(self, config: TruckConfig) -> list[Stretch]:
        """Wheel rates of the run for a robot of this geometry."""
        left = 0.0 if math.isinf(self.ratio) else self.reference / self.ratio
        rate = config.geometry.wheel_radius * (self.reference - left) / config.geometry.track
        return [Stretch(left, self.reference, SETTLING + self.laps * math.tau / rate)]


class StraightRun(Schema):
    """Passes to and fro, each as long as the ideal robot needs."""

    length: Positive = 0.682
    """Length of a pass, m"""
    passes: Annotated[int, Field(ge=1)] = 12
    """Number of passes there and back"""
    reference: Positive = 1.57
    """Rate of all wheels, rad/s"""

    def plan(self, config: TruckConfig) -> list[Stretch]:
        """Wheel rates of the run for a robot of this geometry."""
        seconds = self.length / (config.geometry.wheel_radius * self.reference)
        plan: list[Stretch] = []
        for i in range(self.passes):
            rate = -self.reference if i % 2 else self.reference
            plan += [Stretch(rate, rate, seconds), Stretch(0.0, 0.0, REVERSAL_PAUSE)]
        return plan


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
