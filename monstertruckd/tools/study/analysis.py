"""Analysis of a run of a skid-steer robot: circle, drift of its centre, speed; line, spread, bend, turns at reversals.

Pure numpy on a test stand's poses: times (n,) s, poses (3, n) of x, y (m) and heading (rad, wrapped or not).
"""

from dataclasses import dataclass
from typing import Final

import numpy as np

from monstertruck_kinematics.elementary import Array
from monstertruck_runtime.errors import InputError

LEAST_RUN_POSES: Final = 40
"""Poses of a run, at least."""


@dataclass(frozen=True)
class Circle:
    """A circle whose centre moves evenly."""

    radius: float
    """Radius of the path of the robot's middle, m."""
    speed: float
    """Speed of the robot's middle round the moving centre, m/s."""
    yaw_rate: float
    """Rad/s."""
    drift: tuple[float, float]
    """Drift of the centre, dX/dt and dY/dt, m/s."""
    centre: tuple[float, float]
    """Centre at the beginning, m."""
    arm: tuple[float, float]
    """Robot's middle as seen from the centre, in the robot's frame, m."""
    residual: float
    """RMS distance of the poses from it, m."""
    laps: float


@dataclass(frozen=True)
class StraightPasses:
    """Passes to and fro along a line."""

    passes: int
    length: float
    """Mean distance between the ends of a pass, m."""
    spread: float
    """Maximum distance between the tracks of two passes, across the first one, as a fraction of ``length``."""
    bend: float
    """Mean distance of a pass's middle from its chord, as a share of its length."""
    speed: float
    """Mean over the passes, m/s."""
    reversal_turn: float
    """Mean turn at a reversal, rad."""
    reversal_spread: float
    """Its standard deviation, rad."""


def circle(times: Array, poses: Array) -> Circle:
    """Fit a circle whose centre moves at constant velocity.

    Because the heading is measured, the position is linear in the unknowns: the centre, its drift, and the arm from
    the centre to the robot, which turns with the robot.

    Args:
        times: shape (n,), s, increasing.
        poses: shape (3, n).

    Raises:
        InputError: there are too few poses, numbers that are not finite, or hardly any turn.
    """
    times, poses = _checked(times, poses)
    at, heading = times - times[0], np.unwrap(poses[2])
    turned = float(heading[-1] - heading[0])
    least_turn = 1.0  # radians that a circle must turn: less does not separate its centre from its radius
    if abs(turned) < least_turn:
        raise InputError(f"the run turns by {turned:.2f} rad: expected at least {least_turn:g}, a circle")
    c, s, one, zero = np.cos(heading), np.sin(heading), np.ones_like(at), np.zeros_like(at)
    along_x = np.stack((one, zero, at, zero, c, -s), axis=1)
    along_y = np.stack((zero, one, zero, at, s, c), axis=1)
    design, seen = np.concatenate((along_x, along_y)), np.concatenate((poses[0], poses[1]))
    found, *_ = np.linalg.lstsq(design, seen, rcond=None)
    x, y, dx, dy, ahead, aside = found.tolist()
    radius, rate = float(np.hypot(ahead, aside)), float(np.polyfit(at, heading, 1)[0])
    off = (seen - design @ found).reshape(2, -1)
    return Circle(
        radius=radius,
        speed=radius * abs(rate),
        yaw_rate=rate,
        drift=(dx, dy),
        centre=(x, y),
        arm=(ahead, aside),
        residual=float(np.sqrt((off**2).sum(axis=0).mean())),
        laps=abs(turned) / (2 * np.pi),
    )


def centre_track(poses: Array, found: Circle) -> Array:
    """Centre of rotation as each pose shows it, shape (2, n), m."""
    c, s = np.cos(poses[2]), np.sin(poses[2])
    ahead, aside = found.arm
    return np.array([poses[0] - c * ahead + s * aside, poses[1] - s * ahead - c * aside])


def velocities(times: Array, poses: Array) -> tuple[Array, Array]:
    """Components of the velocity in the stand's frame over windows: times (m,), velocities (2, m), m/s."""
    step = max(1, round(1.0 / float(np.median(np.diff(times)))))  # seconds over which velocities are drawn
    gap = times[step:] - times[:-step]
    return (times[step:] + times[:-step]) / 2, (poses[:2, step:] - poses[:2, :-step]) / gap


def line(times: Array, poses: Array, directions: Array) -> StraightPasses:
    """Passes to and fro.

    Args:
        times: shape (n,), s, increasing.
        poses: shape (3, n).
        directions: shape (n,), sign of the commanded speed at each pose, 0 where none was commanded.

    Raises:
        InputError: there are too few poses, numbers that are not finite, no pass long enough, or one without way.
    """
    times, poses = _checked(times, poses)
    heading = np.unwrap(poses[2])
    cuts = np.flatnonzero(np.diff(directions)) + 1
    # seconds skipped at the start of a run, or of a pass: ramps, and the turn at a reversal
    settled = 1.0
    passes = [
        part[times[part] - times[part[0]] > settled]
        for part in np.split(np.arange(times.size), cuts)
        if directions[part[0]] != 0.0
    ]
    passes = [part for part in passes if part.size >= LEAST_RUN_POSES]
    if not passes:
        raise InputError(f"no pass has {LEAST_RUN_POSES} poses after its first {settled:g} s")
    ends = [_fitted(times[part], poses[:, part]) for part in passes]
    lengths = np.array([np.hypot(*(end - begin)) for begin, _, end in ends])
    least_way = 0.01  # metres that a pass must cover: less has no direction
    if lengths.min() < least_way:
        number, way = int(lengths.argmin()) + 1, 1000 * lengths.min()
        raise InputError(f"pass {number} covers {way:.1f} mm: expected at least {1000 * least_way:g}")
    begin, _, end = ends[0]
    ahead = (end - begin) / np.hypot(*(end - begin))
    across = [np.array([-ahead[1], ahead[0]]) @ (poses[:2, part] - begin[:, None]) for part in passes]
    bends = [_off_chord(*points) / length for points, length in zip(ends, lengths, strict=True)]
    seconds = np.array([times[part[-1]] - times[part[0]] for part in passes])
    lines = [np.polyfit(times[part], heading[part], 1) for part in passes]
    turns = [
        float(np.polyval(after, times[later[0]]) - np.polyval(before, times[earlier[-1]]))
        for before, after, earlier, later in zip(lines, lines[1:], passes, passes[1:], strict=False)
    ]
    return StraightPasses(
        passes=len(passes),
        length=float(lengths.mean()),
        spread=float((max(map(np.max, across)) - min(map(np.min, across))) / lengths.mean()),
        bend=float(np.mean(np.abs(bends))),
        speed=float((lengths / seconds).mean()),
        reversal_turn=float(np.mean(turns)) if turns else 0.0,
        reversal_spread=float(np.std(turns)) if turns else 0.0,
    )


def _fitted(times: Array, poses: Array) -> tuple[Array, Array, Array]:
    """Beginning, middle and end, each (2,), of the parabola through a pass: single poses are noisy."""
    at = np.array([times[0], (times[0] + times[-1]) / 2, times[-1]])
    x, y = (np.polyval(np.polyfit(times - times[0], row, 2), at - times[0]) for row in poses[:2])
    first, middle, last = np.array([x, y]).T
    return first, middle, last


def _off_chord(begin: Array, middle: Array, end: Array) -> float:
    """Distance of the middle from the chord, m, left positive."""
    (ux, uy), (vx, vy) = end - begin, middle - begin
    return float((ux * vy - uy * vx) / np.hypot(ux, uy))


def _checked(times: Array, poses: Array) -> tuple[Array, Array]:
    if poses.shape != (3, times.size):
        raise InputError(f"poses {poses.shape}: expected (3, {times.size})")
    if times.size < LEAST_RUN_POSES:
        raise InputError(f"{times.size} poses of the stand: expected at least {LEAST_RUN_POSES}")
    if not (np.isfinite(times).all() and np.isfinite(poses).all()):
        raise InputError("poses of the stand: expected finite numbers only")
    if (np.diff(times) <= 0).any():
        raise InputError("poses of the stand: expected increasing times")
    return times, poses
