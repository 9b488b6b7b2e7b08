"""Biases of an inertial measurement unit at rest, and the scale of its yaw rate from full turns.

The compass measures the turns.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, Final, Self

import numpy as np

from monstertruck_kinematics.elementary import Array
from monstertruck_kinematics.fitting import least_squares
from monstertruck_runtime.clock import SECOND
from monstertruck_runtime.errors import InputError
from monstertruck_schemas import topics
from monstertruck_schemas.sensor import Attitude, Imu
from monstertruckd.config.calibration import Result, WizardName
from monstertruckd.config.wizards import IMU
from monstertruckd.tools.calibrate.assumed import ASSUMED
from monstertruckd.tools.calibrate.statistics import NORMAL, Interval, correlation_factor, estimated, known_errors
from monstertruckd.tools.calibrate.steps import Collect, MoveRecord, MoveStep, Plot
from monstertruckd.tools.calibrate.wizard import CLEAR, WizardContext

ROOM: Final = "2 m x 2 m, level"
ONE_G: Final = 9.80665
"""Standard gravity, m/s^2."""
TILT: Final = math.radians(0.2)
"""Standard deviation of the compass's tilt, rad (data sheet: 0.5 degrees at most), and so of the direction of
gravity.
"""


@dataclass(frozen=True, slots=True)
class Turn:
    """One turn between two rests."""

    integral: float
    """Integral of the raw yaw rate from rest to rest, rad."""
    seconds: float
    turned: float
    """Turn by the compass, rad, left positive."""
    sigma: float
    """Standard deviation of ``turned``, rad."""

    @classmethod
    def of(cls, record: MoveRecord, bias: float, scale: float) -> "Turn":
        """Create a turn from a move; published rates are corrected by ``bias`` (rad/s) and ``scale``.

        Raises:
            InputError: the unit sent no readings, the readings have a gap, or there are too few headings at rest.
        """
        readings = record.of(topics.IMU)
        if len(readings) < 2:
            raise InputError("the inertial unit sent no data while the robot turned: check its cable")
        stamps = np.array([r.stamp for r in readings], dtype=np.float64) / SECOND
        rates = np.array([r.angular_velocity.z for r in readings]) / scale + bias
        turned, noise = record.turn()
        turned += math.tau * round((record.turned() - turned) / math.tau)
        over = abs(math.remainder(turned, math.tau))
        between = (stamps >= record.left / SECOND - 0.2) & (stamps <= record.arrived / SECOND + 0.2)
        heard = np.concatenate(((record.left / SECOND,), stamps[between], (record.arrived / SECOND,)))
        # 0.5: maximum gap between readings, s: the turn during a gap is unknown
        if (silent := float(np.diff(heard).max())) > 0.5:
            raise InputError(f"the inertial unit was silent for {silent:.1f} s while the robot turned: measure again")
        integral = float(np.trapezoid(rates[between], stamps[between]))
        seconds = float(np.ptp(stamps[between]))
        return cls(integral, seconds, turned, math.hypot(noise, ASSUMED.turn_heading, 0.01 * min(over, 1.0)))


@dataclass(frozen=True, slots=True)
class ImuWizard:
    """Wizard that measures ten seconds at rest, then drives full circles in both directions."""

    name: ClassVar[WizardName] = "imu"
    doc: ClassVar[str] = "biases of the inertial unit at rest, and the scale of its yaw rate from full turns"
    room: ClassVar[str] = ROOM
    rounds: int = 2
    """Number of circles in each direction"""
    turns: bool = True
    """Whether to drive circles for the scale; otherwise only biases are measured, at standstill"""

    @classmethod
    def of(cls, rounds: int, still: bool) -> Self:
        """Create a wizard from the command's options."""
        return cls(rounds, turns=not still)

    async def __call__(self, context: WizardContext) -> Result:
        """Measure."""
        rate = context.value(f"{IMU}.rate_z"), context.value(f"{IMU}.rate_scale")
        await context.confirm(CLEAR)
        resting = await context.collect(Collect("the unit at rest", topics.IMU, 500, 60.0))  # readings at rest
        since = resting[0].stamp
        rates = np.array([((r.stamp - since) / SECOND, math.degrees(r.angular_velocity.z)) for r in resting])
        context.plot(Plot("the unit at rest", "time (s)", "yaw rate (deg/s)", rates))
        tilt = await context.collect(Collect("the robot's tilt", topics.COMPASS, 20))
        turns = []
        angle = 0.35  # angle of both axles, in opposite directions, rad
        if self.turns:
            length = math.tau / context.chassis.bicycle.curvature(angle, -angle)
            for number in range(2 * self.rounds):
                side = 1 if number % 2 == 0 else -1
                move = MoveStep(
                    f"a full circle to the {'left' if side > 0 else 'right'}",
                    0.12,
                    side * angle,
                    -side * angle,
                    1.8 * length,
                    done=lambda record: abs(record.turned()) > math.tau,
                    also=(topics.IMU,),
                )
                turns.append(Turn.of(await context.move(move), float(rate[0]), float(rate[1])))
        before = {name: float(context.value(f"{IMU}.{name}")) for name in _NAMES}
        result = context.fit("biases and scale", lambda: result_of(resting, tilt, turns, before))
        if turns:
            bias, scale = (result.number(name) for name in ("rate_z", "rate_scale"))
            by_unit = np.array([turn.integral - bias * turn.seconds for turn in turns])
            points = np.degrees(np.column_stack((by_unit, [turn.turned for turn in turns])))
            line = np.outer((points[:, 0].min(), points[:, 0].max()), (1.0, scale))
            context.plot(Plot("full turns", "by the unit (deg)", "by the compass (deg)", points, line))
        return result


_NAMES: Final = ("rate_x", "rate_y", "rate_z", "rate_scale", "force_x", "force_y")


def result_of(
    resting: Sequence[Imu], tilt: Sequence[Attitude], turns: Sequence[Turn], before: dict[str, float]
) -> Result:
    """Compute the biases and the scale, and check them.

    Args:
        resting: readings of the unit at rest.
        tilt: tilt of the truck at rest.
        turns: turns between rests; if empty, the scale is kept.
        before: correction already contained in ``resting``, keyed by estimate name.

    Raises:
        InputError: the unit was moved, or there are too few turns.
    """
    rates = np.array([(r.angular_velocity.x, r.angular_velocity.y, r.angular_velocity.z) for r in resting])
    rates = rates / (1.0, 1.0, before["rate_scale"]) + [before[f"rate_{axis}"] for axis in "xyz"]
    # 0.02: maximum standard deviation of the yaw rate at rest, rad/s; above it the unit was moved
    if rates[:, 2].std() > 0.02:
        raise InputError(f"the inertial unit was moved: its yaw rate at rest varies by {rates[:, 2].std():.3f} rad/s")
    forces = np.array([(r.linear_acceleration.x, r.linear_acceleration.y) for r in resting])
    forces += np.array((before["force_x"], before["force_y"]))
    pitch, roll = (float(np.mean([getattr(a, name) for a in tilt])) for name in ("pitch", "roll"))
    gravity = -ONE_G * math.sin(pitch), ONE_G * math.cos(pitch) * math.sin(roll)
    biases = {f"rate_{axis}": _mean(rates[:, i]) for i, axis in enumerate("xyz")}
    shifted = (_mean(forces[:, i] - down).joined(NORMAL * ONE_G * TILT) for i, down in enumerate(gravity))
    biases |= dict(zip(("force_x", "force_y"), shifted, strict=True))
    estimates = [
        estimated(
            name,
            found,
            "rad/s" if name.startswith("rate") else "m/s^2",
            len(resting),
            "bias of the angular velocity at rest; 95 % interval from the noise of the readings"
            if name.startswith("rate")
            else "bias of the specific force; 95 % interval from the noise and the compass's tilt",
            f"{IMU}.{name}",
        )
        for name, found in biases.items()
    ]
    if turns:
        scale = rate_scale(turns, biases["rate_z"])
        meaning = "factor on the yaw rate, from full turns by the compass; 95 % interval from the noise of the turns"
        estimates.append(estimated("rate_scale", scale, "", len(turns), meaning, f"{IMU}.rate_scale"))
    return Result(
        wizard="imu",
        measured=f"{len(resting)} readings at rest and {len(turns)} full turns",
        estimates=tuple(estimates),
        unobserved=(
            "scales of roll and pitch rate",
            "bias and scale of the vertical force, which only other orientations of the unit could separate",
            "temperature effects: the bias drifts, and the estimator corrects it at every standstill",
        ),
        partial=not turns,
    )


def rate_scale(turns: Sequence[Turn], bias: Interval) -> Interval:
    """Factor that makes the integrated yaw rate equal to the turn measured by the compass.

    Raises:
        InputError: there are too few turns, or turns in only one direction, which cannot separate bias and scale.
    """
    least = 2  # minimum number of turns
    if len(turns) < least or len({turn.turned > 0 for turn in turns}) < least:
        raise InputError(f"{len(turns)} turns: expected at least one in each direction")
    rows = np.array([(t.integral, t.seconds, t.turned, t.sigma) for t in turns])
    integral, seconds, turned, sigma = rows.T
    if float((integral - bias.value * seconds) @ turned) < 0.0:
        raise InputError("the yaw rate has the wrong sign: the unit is upside down, or its configured mount is wrong")
    drift = bias.half / NORMAL

    def residual(parameters: Array) -> Array:
        scale, off = parameters
        return np.append((scale * (integral - off * seconds) - turned) / sigma, (off - bias.value) / max(drift, 1e-5))

    fit = least_squares(residual, np.array((1.0, bias.value)), np.array((0.5, -1.0)), np.array((2.0, 1.0)))
    return Interval(float(fit.parameters[0]), float(known_errors(fit, len(turns) - 1)[0]))


def _mean(values: Array) -> Interval:
    """Mean of readings with correlated noise."""
    error = float(values.std(ddof=1)) / math.sqrt(values.size) * correlation_factor(values)
    return Interval(float(values.mean()), NORMAL * error)
