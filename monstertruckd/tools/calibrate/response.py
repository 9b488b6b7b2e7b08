"""Dead time and lag of the steering, from a weaving truck: what the gate commanded, and how the compass turned."""

import math
from collections.abc import Iterable
from typing import Final

import numpy as np

from monstertruck_kinematics.chassis import TruckChassis
from monstertruck_planners.track.response import ResponseEstimate, ResponseEstimator
from monstertruck_runtime.clock import SECOND
from monstertruck_runtime.errors import InputError
from monstertruck_schemas.sensor import Attitude
from monstertruckd.config.calibration import STEERING, Estimate
from monstertruckd.tools.calibrate.statistics import NORMAL
from monstertruckd.tools.calibrate.steps import MoveRecord, MoveStep

WEAVE: Final = 0.8
"""Seconds between two changes of side."""
SPEED: Final = 0.15
ANGLE: Final = 0.2
METRES: Final = 1.8
LAGS: Final = np.linspace(0.0, 0.2, 21)
"""Candidates, s."""
LEAST: Final = 60
"""Turns that dead time and lag have to rest on."""
HIDDEN: Final = 0.03
"""Share of the delay that may be dead time instead of lag, or the other way round, s."""
BASE: Final = 0.4
"""Seconds between two headings that are compared: half a weave, in which the steering changes once."""
GRID: Final = 0.002
"""Error by the spacing of the candidates, s."""


def weaves(rounds: int) -> list[MoveStep]:
    """Forward and back, in turn."""
    return [
        MoveStep(f"weaving {way}", sign * SPEED, ANGLE, -ANGLE, METRES, weave=WEAVE)
        for _ in range(rounds)
        for sign, way in ((1, "ahead"), (-1, "back"))
    ]


def response(records: Iterable[MoveRecord], chassis: TruckChassis) -> ResponseEstimate:
    """Dead time and lag of the axles behind the commands.

    Raises:
        InputError: too few turns were seen.
    """
    estimator = ResponseEstimator(chassis.bicycle, math.inf, LAGS, math.inf)
    for record in records:
        attitude = sorted(record.attitude, key=lambda reading: reading.stamp)
        seconds = (attitude[-1].stamp - attitude[0].stamp) / SECOND if attitude else 0.0
        stride = max(round(BASE * len(attitude) / seconds), 1) if seconds else 1
        for phase in range(stride):
            _replay(record, attitude[phase::stride], chassis, estimator)
    if estimator.estimate.samples < LEAST:
        raise InputError(f"only {estimator.estimate.samples} turns tell dead time and lag: expected {LEAST}")
    return estimator.estimate


def _replay(record: MoveRecord, attitude: list[Attitude], chassis: TruckChassis, estimator: ResponseEstimator) -> None:
    """Have the estimator compare these headings with all commands."""
    times = np.array([reading.stamp for reading in record.drive], dtype=np.float64)
    speeds = [chassis.drivetrain.speed(reading.velocity) for reading in record.drive]
    commands = iter(record.commands)
    command = next(commands, None)
    estimator.forget_requests()
    for reading in attitude:
        while command is not None and command.stamp <= reading.stamp:
            estimator.request(command.stamp / SECOND, (command.front, command.rear))
            command = next(commands, None)
        speed = float(np.interp(reading.stamp, times, speeds))
        estimator.observe(reading.stamp / SECOND, -reading.heading, speed)


def estimates(found: ResponseEstimate) -> list[Estimate]:
    """What is saved of it."""
    noise = f"95 % of the compass's noise, and {1000 * GRID:g} ms of the candidates' spacing"
    divided = f"{noise}; {1000 * HIDDEN:g} ms, as the gate's ramps hide how the delay is divided"
    rows = (
        ("dead_time", found.response.dead_time, found.shape_deviation, HIDDEN, "from a command to the first movement"),
        ("lag", found.response.lag, found.shape_deviation, HIDDEN, "time constant of the turning wheels"),
        ("delay", found.response.total, found.deviation, 0.0, "dead time and lag together"),
    )
    return [
        Estimate(
            name=name,
            value=value,
            low=value - NORMAL * deviation - GRID - bound,
            high=value + NORMAL * deviation + GRID + bound,
            unit="s",
            samples=found.samples,
            meaning=f"{meaning}; {divided if bound else noise}",
            key=f"{STEERING}.{name}" if bound else None,
        )
        for name, value, deviation, bound, meaning in rows
    ]
