"""Identification of a skid-steer robot: from circles driven at known wheel rates, or from a recorded trajectory."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from monstertruck_kinematics.elementary import Array, KinematicsError, require_positive
from monstertruck_kinematics.fitting import FitResult, least_squares, minimax
from monstertruck_kinematics.se2 import integrate, to_body
from monstertruck_kinematics.unsteered import SkidSteer


@dataclass(frozen=True)
class MeasuredCircle:
    """One circle: wheel rates in rad/s, measured radius (m) and speed (m/s) of the robot's centre."""

    label: str
    left: float
    right: float
    radius: float
    speed: float


PUBLISHED_RADIUS = 0.021
PUBLISHED_HALF_TRACK = 0.0525
PUBLISHED_CIRCLES = (
    MeasuredCircle("2:1, 1.57 rad/s", 0.785, 1.57, 0.21, 0.0273),
    MeasuredCircle("2:1, 1.25 rad/s", 0.625, 1.25, 0.21, 0.0223),
    MeasuredCircle("2:1, 1.04 rad/s", 0.52, 1.04, 0.21, 0.0181),
    MeasuredCircle("3:1, 1.57 rad/s", 1.57 / 3.0, 1.57, 0.155, 0.0245),
    MeasuredCircle("3:1, 1.25 rad/s", 1.25 / 3.0, 1.25, 0.155, 0.0187),
    MeasuredCircle("3:1, 1.04 rad/s", 1.04 / 3.0, 1.04, 0.155, 0.0166),
    MeasuredCircle("left locked, 1.57 rad/s", 0.0, 1.57, 0.055, 0.0188),
)
"""The skid-steer paper's table; the faster side is taken as the right one.

It prints the deviations of the locked circle without sign; they are taken as positive, like all others."""


@dataclass(frozen=True)
class SkidModel:
    """A parametrised skid-steer robot.

    Attributes:
        name: name of the model.
        parameters: their names, in order.
        start: first guess.
        lower: bounds.
        upper: bounds.
        build: robot from a parameter vector.
    """

    name: str
    parameters: tuple[str, ...]
    start: Array
    lower: Array
    upper: Array
    build: Callable[[Array], SkidSteer]


ModelName = Literal["effective radius", "symmetric", "centre of mass", "icr", "icr and slip"]
MODEL_NAMES: tuple[ModelName, ...] = ("effective radius", "symmetric", "centre of mass", "icr", "icr and slip")


def skid_model(
    name: ModelName, radius: float, half_track: float, *, bounded: bool = True, with_icr_x: bool = False
) -> SkidModel:
    """One of the models, around a robot's nominal dimensions.

    All have a gain (effective over nominal radius). ``symmetric`` adds one effective half track, ``centre of mass`` an
    offset of the centre (ICRs c - y and -c - y), ``icr`` the two sides' ICRs, ``icr and slip``
    also the ratio of the sides' gains.

    Args:
        name: name of the model.
        radius: nominal wheel radius, m.
        half_track: c, m.
        bounded: keep the ICRs within 3 c and the slip ratio within 1.15; else only to physical signs.
        with_icr_x: also fit x_ICR, which circles alone do not show.

    Raises:
        KinematicsError: unknown name, or a length not above 0.
    """
    require_positive("radius", radius)
    require_positive("half_track", half_track)
    # 3.0: bounds of a plausible fit: gain of one side over the other, and ICRs in half tracks
    far = 3.0 * half_track if bounded else 100.0 * half_track
    slip = 1.15 if bounded else 10.0
    near = 0.1 * half_track
    table: dict[str, tuple[float, float, float]] = {
        "gain": (1.0, 0.3, 3.0),
        "half_track": (half_track, near, far),
        "offset_y": (0.0, half_track - far, far - half_track),
        "icr_left": (half_track, near, far),
        "icr_right": (-half_track, -far, -near),
        "slip_ratio": (1.0, 1.0 / slip, slip),
        "icr_x": (0.0, -far, far),
    }
    chosen = {
        "effective radius": ("gain",),
        "symmetric": ("gain", "half_track"),
        "centre of mass": ("gain", "offset_y"),
        "icr": ("gain", "icr_left", "icr_right"),
        "icr and slip": ("gain", "icr_left", "icr_right", "slip_ratio"),
    }
    if name not in chosen:
        raise KinematicsError(f"model {name!r}: expected one of {', '.join(MODEL_NAMES)}")
    names = (*chosen[name], "icr_x") if with_icr_x else chosen[name]

    def build(values: Array) -> SkidSteer:
        got = dict(zip(names, values.tolist(), strict=True))
        half, offset = got.get("half_track", half_track), got.get("offset_y", 0.0)
        tilt = math.sqrt(got.get("slip_ratio", 1.0))
        return SkidSteer(
            radius,
            icr_left=got.get("icr_left", half - offset),
            icr_right=got.get("icr_right", -half - offset),
            icr_x=got.get("icr_x", 0.0),
            gain_left=got["gain"] / tilt,
            gain_right=got["gain"] * tilt,
        )

    start, lower, upper = (np.array([table[key][i] for key in names]) for i in range(3))
    return SkidModel(name, names, start, lower, upper, build)


@dataclass(frozen=True)
class SkidFit:
    """An identified robot."""

    model: SkidModel
    robot: SkidSteer
    fit: FitResult

    def parameter_table(self) -> list[tuple[str, float, float]]:
        """Name, value and standard error of every parameter."""
        values, errors = self.fit.parameters.tolist(), self.fit.standard_errors.tolist()
        return list(zip(self.model.parameters, values, errors, strict=True))


def circle_errors(robot: SkidSteer, circles: Sequence[MeasuredCircle]) -> Array:
    """(2, n) relative errors of a robot's radius and speed against the measured circles."""
    left, right = (np.array([getattr(c, side) for c in circles]) for side in ("left", "right"))
    vx, vy, wz = robot.forward((left, right))
    speed = np.hypot(vx, vy)
    radius = speed / np.abs(wz)
    return np.array(
        [radius / [c.radius for c in circles] - 1.0, speed / [c.speed for c in circles] - 1.0],
    )


def fit_circles(
    circles: Sequence[MeasuredCircle],
    model: SkidModel,
    *,
    objective: Literal["least squares", "minimax"] = "least squares",
    radii_only: bool = False,
) -> SkidFit:
    """Fit a model to circles by the relative errors of radius and speed.

    Args:
        circles: measured circles.
        model: from ``skid_model``.
        objective: sum of squares, or the largest error.
        radii_only: ignore the speeds (the gain then stays 1).

    Raises:
        KinematicsError: no circles or too few for the model, or a circle driven straight.
    """
    if not circles:
        raise KinematicsError("circles is empty: expected at least one")
    for circle in circles:
        if circle.left == circle.right:
            raise KinematicsError(f"circle {circle.label}: left and right rates are equal, it has no radius")

    def residual(values: Array) -> Array:
        errors = circle_errors(model.build(values), circles)
        return np.asarray(errors[0] if radii_only else errors.ravel())

    solve = least_squares if objective == "least squares" else minimax
    held = np.array([radii_only and name == "gain" for name in model.parameters])
    lower, upper = np.where(held, model.start, model.lower), np.where(held, model.start, model.upper)
    fit = solve(residual, model.start, lower, upper)
    return SkidFit(model, model.build(fit.parameters), fit)


def unexplained_spread(circles: Sequence[MeasuredCircle]) -> float:
    """Relative speed error that every model linear in the wheel rates must leave.

    Circles of one ratio differ only in rate, so the model's speed over rate is one number while the measured ones
    spread; the best single number misses the extremes by (max - min)/(max + min).
    """
    groups: dict[float, list[float]] = {}
    for circle in circles:
        groups.setdefault(round(circle.left / circle.right, 9), []).append(circle.speed / abs(circle.right))
    return max((max(g) - min(g)) / (max(g) + min(g)) for g in groups.values())


def fit_trajectory(
    times: Array,
    rates: Array,
    poses: Array,
    model: SkidModel,
    *,
    window: int = 10,
    huber: float | None = 3.0,
    position_noise: float = 0.005,
    heading_noise: float = 0.01,
) -> SkidFit:
    """Identify a robot from a recorded trajectory: predicted against measured motion over windows of samples.

    Args:
        times: (N,) s, increasing.
        rates: (2, N) left and right wheel rates, rad/s, each held until the next sample.
        poses: (3, N) measured x, y (m) and heading (rad, continuous or wrapped).
        model: from ``skid_model``.
        window: samples over which motion is predicted; longer windows weigh noise less.
        huber: residual, in units of the noise, above which a window counts linearly; None for plain squares.
        position_noise: expected error of a window's displacement, m.
        heading_noise: heading noise of its turn, rad.

    Raises:
        KinematicsError: shapes that do not fit together, times that do not increase, NaN, or too few samples.
    """
    count = times.size
    if rates.shape != (2, count) or poses.shape != (3, count):
        raise KinematicsError(f"rates {rates.shape}, poses {poses.shape}: expected (2, {count}) and (3, {count})")
    if not (np.isfinite(times).all() and np.isfinite(rates).all() and np.isfinite(poses).all()):
        raise KinematicsError("times, rates, poses: expected finite numbers only")
    gaps = np.diff(times)
    if (gaps <= 0.0).any():
        raise KinematicsError(f"times[{int(np.argmax(gaps <= 0.0)) + 1}]: expected increasing times")
    if window < 1 or count <= window:
        raise KinematicsError(f"window is {window}: expected 1 to {count - 1} samples")
    starts = np.arange(0, count - window, max(1, window // 2))
    ends = starts + window
    ahead, aside = to_body(poses[2, starts], poses[0, ends] - poses[0, starts], poses[1, ends] - poses[1, starts])
    turned = np.unwrap(poses[2])[ends] - np.unwrap(poses[2])[starts]
    scale = np.array([[position_noise], [position_noise], [heading_noise]])

    def residual(values: Array) -> Array:
        vx, vy, wz = model.build(values).forward((rates[0], rates[1]))
        pose: tuple[Array, Array, Array] = (np.zeros(starts.size), np.zeros(starts.size), np.zeros(starts.size))
        for k in range(window):
            i = starts + k
            step = gaps[i]
            pose = integrate(pose, vx[i] * step, vy[i] * step, wz[i] * step, 1.0)
        return np.asarray(((np.array(pose) - [ahead, aside, turned]) / scale).ravel())

    fit = least_squares(residual, model.start, model.lower, model.upper, huber=huber)
    return SkidFit(model, model.build(fit.parameters), fit)
