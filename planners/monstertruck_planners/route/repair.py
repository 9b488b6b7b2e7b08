"""Conversion of a drawn path to a drivable one: Reeds-Shepp motions, with cusps, replace its impossible bends.

Loads numba.
"""

import math
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from monstertruck_kinematics.elementary import Array
from monstertruck_kinematics.truck import FourWheelSteering
from monstertruck_planners.pose_path import PosePath
from monstertruck_planners.route.api import Vehicle
from monstertruck_planners.route.config import DriveCosts
from monstertruck_planners.track.config import TrackerConfig
from monstertruck_planners.track.drivable import Bend, bends
from monstertruck_runtime.errors import InputError
from monstertruck_schemas.plan import MAX_RUNS, Path


def repaired(
    path: Path,
    config: TrackerConfig,
    geometry: FourWheelSteering,
    free: Callable[[Array], NDArray[np.bool_]] | None = None,
) -> tuple[Path, list[str]]:
    """Replace all bends that the body cannot drive.

    Args:
        path: see ``check_path``.
        config: tolerance, axle angle and steering mode of the tracker.
        geometry: geometry of the body.
        free: whether poses (n, 3) are free on the map, shape (n,); None without a map.

    Returns:
        The path, and a text for each replaced bend.

    Raises:
        InputError: a bend has no replacement, or an obstacle blocks the replacement; names the place.
    """
    texts: list[str] = []
    while (found := next(bends(path, config, geometry), None)) is not None:
        bend, _ = found
        if len(texts) == MAX_RUNS or path.closed:
            limit = "a lap must be repaired by hand" if path.closed else f"expected at most {MAX_RUNS} bends to repair"
            raise InputError(f"path {path.name!r}: {limit}")
        piece = _piece(path, bend, config, geometry)
        x, y = path.poses.reshape(-1, 3)[bend.first, :2]
        if free is not None and not (clear := free(piece.poses)).all():
            bx, by = piece.poses[np.flatnonzero(~clear)[0], :2]
            raise InputError(
                f"path {path.name!r}, pose {bend.first} at {x:.2f}, {y:.2f} m: the replacement turn would "
                f"touch an obstacle of the map at {bx:.2f}, {by:.2f} m"
            )
        texts.append(
            f"pose {bend.first} at {x:.2f}, {y:.2f} m: {len(piece.stops)} changes of direction in {piece.length:.2f} m "
            f"turn by {abs(math.degrees(bend.turn)):.0f} degrees"
        )
        path = _with(path, bend, piece)
    return path, texts


def _piece(path: Path, bend: Bend, config: TrackerConfig, geometry: FourWheelSteering) -> PosePath:
    """Return the motion of the base that replaces a bend."""
    drawn = PosePath.of(path)
    poses = drawn.poses[bend.first : bend.last + 1]
    direction = float(drawn.directions[bend.last])
    count = math.ceil(abs(bend.turn) / math.pi - 1e-6)  # a shortest motion would omit a whole turn
    at = np.linspace(0, len(poses) - 1, count + 1).round().astype(np.intp)
    begin = _heading(drawn.poses, bend.first) + (0.0 if direction > 0 else math.pi)
    stations = np.column_stack((poses[at, :2], begin + bend.turn * np.linspace(0.0, 1.0, count + 1)))
    vehicle = Vehicle.truck("2ws" if config.steering == "front" else "counter", angle=config.angle, geometry=geometry)
    # 1.5: cost per metre in the opposite direction: the first and the last arc continue like the path
    planner = vehicle.reeds_shepp(DriveCosts(reverse_cost=1.5))
    piece: PosePath | None = None
    for start, end in pairwise(stations):
        ends = [vehicle.reference_pose(pose) for pose in (start, end)]
        motion = planner.path(*ends).base_path() if direction > 0 else _undone(planner.path(*ends[::-1]).base_path())
        piece = motion if piece is None else piece.then(motion)
    assert piece is not None
    directions = piece.directions.copy()
    directions[0] = direction  # the robot arrives as drawn
    return replace(
        piece, directions=directions, steering=(vehicle.steering,) * len(piece.poses) if path.steering else ()
    )


def _undone(motion: PosePath) -> PosePath:
    """Return a motion from its end to its start."""
    return PosePath(motion.poses[::-1], -np.roll(motion.directions, -1)[::-1])


def _heading(poses: Array, index: int) -> float:
    """Return the direction of the step that leads to a pose."""
    before = index - 1
    while before > 0 and math.dist(poses[before, :2], poses[index, :2]) < 1e-6:
        before -= 1
    x, y = poses[index, :2] - poses[before, :2]
    return math.atan2(y, x)


def _with(path: Path, bend: Bend, piece: PosePath) -> Path:
    """Return the path with a motion in place of a bend."""
    drawn = PosePath.of(path)
    before, after = drawn.part(0, bend.first), drawn.part(bend.last + 1, len(drawn.poses))
    whole = np.vstack((before.poses, piece.poses, after.poses))
    directions = np.concatenate((before.directions, piece.directions, after.directions))
    changed = {"poses": whole.ravel(), "directions": directions, "clearance": np.zeros(0)}
    if drawn.steering:
        changed["steering"] = (*before.steering, *piece.steering, *after.steering)  # type: ignore[assignment]
    if drawn.speeds is not None:
        speed = float(drawn.speeds[bend.first : bend.last + 1].min())
        changed["speeds"] = np.concatenate(
            (drawn.speeds[: bend.first], np.full(len(piece.poses), speed), drawn.speeds[bend.last + 1 :])
        )
    return path.model_copy(update=changed)
