"""Hard and soft iron of the compass, from circles driven on level ground.

On level ground the horizontal magnetic field of a turning truck traces a circle. The truck's iron shifts the circle
(hard iron) and deforms it to an ellipse (soft iron). A level circle determines only this ellipse: not the vertical
iron, the field strength, or the rotation of the mounted compass.
"""

import math
from dataclasses import dataclass
from typing import ClassVar, Final

import numpy as np

from monstertruck_drivers.os4000.attitude import level_field
from monstertruck_drivers.os4000.config import IronConfig
from monstertruck_kinematics.elementary import Array
from monstertruck_kinematics.fitting import FitResult, least_squares
from monstertruck_kinematics.se2 import wrap
from monstertruck_runtime.errors import InputError
from monstertruck_schemas import topics
from monstertruckd.config.calibration import Estimate, Result, WizardName
from monstertruckd.config.wizards import COMPASS
from monstertruckd.tools.calibrate.statistics import NORMAL, Interval, correlation_factor, estimated, mean_angle
from monstertruckd.tools.calibrate.steps import MoveRecord, MoveStep, Plot
from monstertruckd.tools.calibrate.wizard import CLEAR, WizardContext

ROOM: Final = "2 m x 2 m, level, outdoors or away from iron: no car, reinforced wall or drain within 3 m"

TILT: Final = math.radians(0.5)
"""Maximum tilt error of the compass, rad (data sheet): through it the vertical field looks like hard iron."""
LINEARITY: Final = 0.001
"""Relative nonlinearity of a magnetoresistive sensor over the earth's field, and of the ellipse."""
GAP: Final = math.radians(30)
"""Maximum gap between field directions in a circle."""

_NAMES: Final = ("hard_x", "hard_y", "soft_xx", "soft_xy", "soft_yy")


@dataclass(frozen=True, slots=True)
class FieldCircle:
    """Readings from the driven circles, (n,) each: field (microtesla), tilt (rad), motor current (A)."""

    x: Array
    y: Array
    z: Array
    pitch: Array
    roll: Array
    current: Array
    heading: Array
    """Heading of the compass, or by the previous calibration; rad, clockwise."""

    @classmethod
    def of(cls, tracks: list[MoveRecord]) -> "FieldCircle":
        """Select the readings taken while the truck moved, including those that the driver flagged as disturbed.

        Raises:
            InputError: the compass sends no field or too few readings.
        """
        rows = []
        for track in tracks:
            moving = [
                a
                for a in track.of(topics.COMPASS)
                if track.left < a.stamp < track.arrived and a.magnetic_field is not None
            ]
            currents = track.currents_at(np.array([a.stamp for a in moving], dtype=np.float64))
            for a, current in zip(moving, currents, strict=True):
                field = a.magnetic_field
                assert field is not None
                rows.append((field.x, field.y, field.z, a.pitch, a.roll, current, a.heading))
        if not rows:
            raise InputError(
                "the compass sends no magnetic field: set bit 64 of its field mask (devices.compass.driver.fields)"
            )
        fewest = 24  # minimum number of readings: one per 30 degrees of both circles
        if len(rows) < fewest:
            raise InputError(f"the compass sent {len(rows)} readings while the robot moved: expected {fewest} or more")
        return cls(*np.array(rows).T)

    def plot(self, iron: IronConfig | None = None) -> Plot:
        """Plot the horizontal field, and the ellipse into which ``iron`` deforms a circle."""
        field, ellipse = np.column_stack((self.x, self.y)), None
        if iron is not None:
            soft = np.array(((iron.soft_xx, iron.soft_xy), (iron.soft_xy, iron.soft_yy)))
            hard = np.array((iron.hard_x, iron.hard_y))
            radius = float(np.hypot(*(soft @ (field - hard).T)).mean())
            around = np.linspace(0.0, math.tau, 73)  # every 5 degrees
            ellipse = hard + radius * np.column_stack((np.cos(around), np.sin(around))) @ np.linalg.inv(soft)
        return Plot("magnetic field on the circle", "field ahead (uT)", "field to the left (uT)", field, ellipse)


@dataclass(frozen=True, slots=True)
class CompassWizard:
    """Wizard that drives one circle forward and one back: the effect of the motor current changes sign."""

    name: ClassVar[WizardName] = "compass"
    doc: ClassVar[str] = "magnetism of the robot, from a driven circle"
    room: ClassVar[str] = ROOM
    speed: float = 0.07
    """m/s: slow, because the heading of a compass near much iron leads and lags, which the gate would take for steering
    that does not follow
    """

    async def __call__(self, context: WizardContext) -> Result:
        """Measure."""
        context.value("devices.compass.driver.rate")
        context.say(
            "Switch on motor and computer and mount everything as for driving; keep phones and keys away "
            "from the compass."
        )
        await context.confirm(CLEAR)
        angle = 0.35  # angle of both axles, in opposite directions, rad: a circle of 0.44 m
        length = 2 * math.pi / context.chassis.bicycle.curvature(angle, -angle)
        full = 2 * math.pi * 1.05  # number of turns
        tracks = [
            await context.move(
                MoveStep(
                    name,
                    speed,
                    angle,
                    -angle,
                    metres=1.8 * length,
                    done=lambda track: abs(track.turned()) > full,
                    also=(topics.COMPASS,),
                )
            )
            for name, speed in (("a circle to the left", self.speed), ("the same circle backwards", -self.speed))
        ]
        circle = FieldCircle.of(tracks)
        context.plot(circle.plot())
        result = context.fit("ellipse", lambda: result_of(circle))
        context.plot(circle.plot(IronConfig(**{name: result.number(name) for name in _NAMES})))
        return result


def result_of(circle: FieldCircle) -> Result:
    """Fit the ellipse and check it.

    Raises:
        InputError: the circle is incomplete, the field turns in the wrong direction, or the shape is not an ellipse.
    """
    if np.ptp(circle.heading) == 0.0:
        raise InputError(
            "the compass heading stays constant while the robot turns: unplug the compass and plug it in again"
        )
    fit = fit_ellipse(circle)
    iron = IronConfig(**dict(zip(_NAMES, _iron(fit.parameters), strict=True)))
    angle = _angles(circle, iron)
    _check_coverage(angle)
    if np.corrcoef(np.diff(np.unwrap(angle)), np.diff(np.unwrap(circle.heading)))[0, 1] < 0:
        raise InputError(
            "the field turns opposite to the compass heading: its axes are not x forward, y left; change "
            "its mounting setting (E)"
        )
    radius = float(fit.parameters[4])
    # 0.03: maximum residual of an ellipse, as a fraction of the circle's radius: it corresponds to a heading error of 2
    # degrees
    if not np.isfinite(fit.standard_errors[:5]).all() or fit.rms > 0.03 * radius:
        raise InputError(
            f"the field deviates by {fit.rms:.1f} uT from the {radius:.0f} uT ellipse that the robot's "
            "iron can cause: a magnet near the compass, or iron in the ground or passing by, disturbs "
            "it; calibrate elsewhere or move the compass"
        )
    errors = NORMAL * correlation_factor(fit.residuals) * _iron_errors(fit)
    vertical = float(np.abs(circle.z).mean()) * math.sin(TILT)
    # 3.0: bound of the ellipse's error as a multiple of the result of ``lasting``, iron in the ground: of random bumps
    # from 0.3 to 4 microtesla, 96 % shift its middle by less, and 93 % its shape
    ground = 3.0 * lasting(fit.residuals)
    bounds = [vertical + ground if name.startswith("hard") else LINEARITY + ground / radius for name in _NAMES]
    taken_out = np.degrees(np.abs(wrap(circle.heading - angle - mean_angle(circle.heading - angle))).max())
    tilt = (
        f"95 % interval from the noise of the readings, {math.degrees(TILT):g} deg of tilt error of the "
        "compass, and iron in the ground"
    )
    estimates = [
        Estimate(
            name=name,
            value=value,
            low=value - error - bound,
            high=value + error + bound,
            unit="uT" if name.startswith("hard") else "",
            samples=circle.x.size,
            meaning=f"hard iron, in the scale of the compass; {tilt}"
            if name.startswith("hard")
            else "turns the ellipse into a circle, determinant 1; 95 % interval from the noise of the "
            f"readings, {LINEARITY:.1%} of nonlinearity, and iron in the ground",
            key=f"{COMPASS}.{name}",
        )
        for name, value, error, bound in zip(_NAMES, _iron(fit.parameters), errors, bounds, strict=True)
    ]
    estimates += _motor(circle, fit)
    estimates.append(
        Estimate(
            name="taken_out",
            value=float(taken_out),
            unit="deg",
            samples=circle.x.size,
            meaning="maximum change of the heading by this calibration, apart from a constant rotation",
        )
    )
    return Result(
        wizard="compass",
        measured=f"{circle.x.size} readings on a level circle driven forwards and backwards; residual {fit.rms:.2f} uT",
        estimates=tuple(estimates),
        unobserved=(
            "hard and soft iron along z: on a slope the heading error reaches (hard_z / horizontal field) x slope",
            "the field strength: all values are in the scale of the compass",
            "a rotation of the compass on the robot: it is a constant heading error",
        ),
    )


def lasting(residuals: Array) -> float:
    """RMS of the slowly varying part of the residuals, over an eighth of a circle; 0 for pure noise.

    The residuals must be in chronological order. The result is computed from means over an eighth of the readings,
    minus their noise; values up to twice the noise are treated as noise.
    """
    window = max(residuals.size // 16, 1)
    means = np.convolve(residuals, np.ones(window) / window, "valid")
    power, noise = float(np.mean(means**2)), float(np.mean(np.diff(residuals) ** 2)) / 2 / window
    return math.sqrt(power - noise) if power > 2.0 * noise else 0.0


def _motor(circle: FieldCircle, fit: FitResult) -> list[Estimate]:
    """Magnetic field per ampere of motor current, and its maximum effect on the heading."""
    if not np.isfinite(fit.standard_errors[5:]).all():
        return []
    halves = NORMAL * correlation_factor(fit.residuals) * fit.standard_errors[5:]
    radius = float(fit.parameters[4])
    found = list(zip(("motor_x", "motor_y"), fit.parameters[5:].tolist(), halves.tolist(), strict=True))
    amount = math.hypot(*(value for _, value, _ in found))
    turn = Estimate(
        name="motor_turn",
        value=math.degrees(amount / radius),
        low=math.degrees(max(amount - math.hypot(*halves), 0.0) / radius),
        high=math.degrees((amount + math.hypot(*halves)) / radius),
        unit="deg/A",
        samples=circle.x.size,
        meaning="maximum heading change per ampere of motor current, across the disturbance; for information",
    )
    meaning = (
        "magnetic field per ampere of motor current, forward positive; 95 % interval from the noise of the readings"
    )
    fields = (estimated(name, Interval(value, half), "uT/A", circle.x.size, meaning) for name, value, half in found)
    return [*fields, turn]


def fit_ellipse(circle: FieldCircle) -> FitResult:
    """Fit the length of the levelled field by least squares; parameters hard_x, hard_y, u, v, radius, motor_x, motor_y.

    ``soft`` is [[e^u w, v], [v, w e^-u]] with w^2 = 1 + v^2: symmetric, determinant 1. ``motor`` is the magnetic field
    per ampere of motor current (uT/A).
    """
    middle = np.array([(values.max() + values.min()) / 2 for values in (circle.x, circle.y)])
    radius = max(float(np.ptp(circle.x)), float(np.ptp(circle.y)), 1.0) / 2
    start = np.array((*middle, 0.0, 0.0, radius, 0.0, 0.0))
    no_current = float(np.ptp(circle.current)) < 0.05
    free = np.array((np.inf, np.inf, 0.7, 0.7, np.inf, *((0.0, 0.0) if no_current else (np.inf, np.inf))))
    lower = np.where(np.isfinite(free), -free, -np.inf)

    def residual(parameters: Array) -> Array:
        iron = IronConfig(**dict(zip(_NAMES, _iron(parameters), strict=True)))
        motor_x, motor_y = parameters[5:]
        field = circle.x - motor_x * circle.current, circle.y - motor_y * circle.current, circle.z
        forward, left = level_field(field, circle.pitch, circle.roll, iron)
        return np.asarray(np.hypot(forward, left) - parameters[4])

    return least_squares(residual, start, lower, free)


def _iron(parameters: Array) -> tuple[float, ...]:
    x, y, u, v = (float(value) for value in parameters[:4])
    w = math.sqrt(1 + v * v)
    return x, y, w * math.exp(u), v, w * math.exp(-u)


def _iron_errors(fit: FitResult) -> Array:
    """Standard errors in the order of ``_NAMES``, propagated through the derivatives of ``_iron``."""
    point, errors = fit.parameters[:4], fit.standard_errors[:4]
    step = 1e-6
    slopes = np.array(
        [(np.array(_iron(point + step * row)) - np.array(_iron(point - step * row))) / (2 * step) for row in np.eye(4)]
    )
    return np.asarray(np.sqrt((slopes**2).T @ errors**2))


def _angles(circle: FieldCircle, iron: IronConfig) -> Array:
    """Headings from the field corrected by ``iron`` (rad)."""
    forward, left = level_field((circle.x, circle.y, circle.z), circle.pitch, circle.roll, iron)
    return np.asarray(np.arctan2(left, forward))


def _check_coverage(angles: Array) -> None:
    around = np.sort(angles)
    gap = float(max(np.diff(around).max(), around[0] + 2 * math.pi - around[-1]))
    if gap > GAP:
        raise InputError(
            f"the robot did not complete the circle: {math.degrees(gap):.0f} deg are missing; calibrate "
            "the steering's directions first"
        )
