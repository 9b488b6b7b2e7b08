"""Camera mount from a board visible to camera and lidar: lidar points on the board lie in the plane seen by the camera.

Zhang and Pless, "Extrinsic calibration of a camera and laser range finder (improves camera calibration)", IROS 2004: in
every view the camera measures the plane of the board, and the lidar's points on the board must lie in it. A view gives
two equations: the distance of the line's midpoint from the plane, and the angle between line and plane. At least six
views with different tilts determine the six parameters of the mount. The fit also estimates the true size of the board
and the lidar's range bias.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from monstertruck_estimation.vision.board import BoardReader
from monstertruck_estimation.vision.lens import BoardPose, Lens, board_pose
from monstertruck_estimation.vision.mount import camera_axes
from monstertruck_kinematics.elementary import Array, rotation
from monstertruck_kinematics.fitting import FitResult, least_squares
from monstertruck_runtime.errors import InputError
from monstertruck_schemas.board import BoardConfig
from monstertruck_schemas.body import Mount
from monstertruckd.tools.calibrate.assumed import ASSUMED
from monstertruckd.tools.calibrate.board_views import BoardView

NAMES: Final = ("x", "y", "z", "yaw", "pitch", "roll")
"""Parameters of the camera mount."""
LEAST_VIEWS: Final = 6
REACH: Final = np.array((0.5, 0.5, 0.5, 0.8, 0.8, 0.8))
"""Maximum error of the configured mount, m and rad."""


class LidarPlace(NamedTuple):
    """Configured mount of the lidar on the body."""

    place: Array
    """Position, shape (3,), m."""
    axes: Array
    """Rotation, shape (3, 3), from the lidar's axes to the axes of the body."""

    @classmethod
    def of(cls, mount: Mount, pitch: float = 0.0, roll: float = 0.0) -> "LidarPlace":
        """Return the mount with its joints at ``pitch`` and ``roll`` (rad)."""
        place = np.array((mount.x, mount.y, mount.z))
        return cls(place, rotation(0.0, pitch, roll) @ rotation(mount.yaw, mount.pitch, mount.roll))


@dataclass(frozen=True, slots=True)
class BoardLine:
    """A line of lidar points on a board that the camera also sees."""

    pose: BoardPose
    """Pose of the board in front of the camera"""
    ends: Array
    """Ends of the lidar's line on the board, in the lidar's axes, shape (2, 3), m"""
    sigmas: tuple[float, float]
    """Standard deviations: distance of the line's middle from the plane, m, and angle between line and plane, rad"""


def line_on_board(
    view: BoardView, reader: BoardReader, lens: Lens, mount: Array, lidar: LidarPlace, *, known: bool
) -> BoardLine | None:
    """Find the lidar's line on the board of a view; None if there is none.

    Args:
        view: view with scans.
        reader: reader of the board.
        lens: lens of the camera.
        mount: mount of the camera, ``NAMES``.
        lidar: mount of the lidar.
        known: whether the mount has already been fitted.
    """
    pose = board_pose(view.sighting, reader, lens)
    if pose is None or not view.ranges.size:
        return None
    finite = np.isfinite(view.ranges)
    flat = np.where(finite, view.ranges, 0.0)[:, None] * directions(view.angles)
    on = in_board(flat, pose, mount, lidar)
    # (0.12, 0.0): m: tolerance around the board, before and after the mount is known
    board, margin = reader.board, (0.12, 0.0)[known]
    inside = (on[:, 0] > -margin) & (on[:, 0] < board.width + margin)
    inside &= (on[:, 1] > -margin) & (on[:, 1] < board.height + margin)
    edges = 2  # number of beams at each end of the board that may have hit its edge
    # (0.2, 0.04): m: tolerance around the board's plane, before and after the mount is known
    run = longest(finite & inside & (np.abs(on[:, 2]) < (0.2, 0.04)[known]), view.ranges)[edges:-edges]
    if run.size < 10:  # minimum number of beams on the board
        return None
    points = flat[run]
    middle = points.mean(axis=0)
    direction = np.linalg.svd(points - middle)[2][0]
    along = (points - middle) @ direction
    off = np.linalg.norm(points - middle - along[:, None] * direction, axis=1)
    noise = float(np.sqrt(np.mean(off**2)))
    if noise > 0.02:  # m: maximum RMS distance of a line's points
        return None
    half = float(np.abs(along).max())
    ends = middle + np.array(((-half,), (half,))) * direction
    by_plane = plane_sigmas(view, reader, lens, pose, in_camera(ends, mount, lidar))
    lidar_sigmas = noise / math.sqrt(run.size), noise / math.sqrt(float(along @ along))
    return BoardLine(
        pose,
        ends,
        (
            math.hypot(lidar_sigmas[0], by_plane[0], ASSUMED.board_flatness),
            math.hypot(lidar_sigmas[1], by_plane[1], ASSUMED.board_warp),
        ),
    )


def directions(angles: Array) -> Array:
    """Unit vectors along the beams in the lidar frame, shape (n, 3)."""
    return np.column_stack((np.cos(angles), np.sin(angles), np.zeros(angles.size)))


def in_camera(points: Array, mount: Array, lidar: LidarPlace) -> Array:
    """Transform lidar points (m) to the camera frame; input and result have shape (n, 3)."""
    x, y, z, yaw, pitch, roll = mount.tolist()
    on_body = points @ lidar.axes.T + lidar.place
    return np.asarray((on_body - (x, y, z)) @ camera_axes(yaw, pitch, roll))


def in_board(points: Array, pose: BoardPose, mount: Array, lidar: LidarPlace) -> Array:
    """Transform lidar points (m) to the board frame (right, down, behind); input and result have shape (n, 3)."""
    return np.asarray((in_camera(points, mount, lidar) - pose.place) @ pose.axes)


def longest(chosen: NDArray[np.bool_], ranges: Array) -> NDArray[np.intp]:
    """Indices of the longest run of selected beams without a jump in range."""
    step = np.zeros(chosen.size, dtype=bool)
    with np.errstate(invalid="ignore"):
        step[1:] = ~(
            np.abs(np.diff(ranges)) < 0.05
        )  # minimum range step between adjacent beams that cannot be on the board, m
    groups = np.cumsum(~chosen | step)
    numbers, counts = np.unique(groups[chosen], return_counts=True)
    if not numbers.size:
        return np.empty(0, np.intp)
    return np.flatnonzero(chosen & (groups == numbers[np.argmax(counts)]))


def plane_sigmas(view: BoardView, reader: BoardReader, lens: Lens, pose: BoardPose, ends: Array) -> tuple[float, float]:
    """Standard deviations due to corner noise: of the plane at the line's midpoint (m), and of its slope (rad).

    Args:
        view: view of the board.
        reader: reader that found the board.
        lens: lens of the camera.
        pose: pose of the board.
        ends: end points of the line in the camera frame (m), shape (2, 3).
    """
    start = np.concatenate((np.ravel(cv2.Rodrigues(pose.axes)[0]), pose.place))
    _, slopes = cv2.projectPoints(reader.points[view.sighting.ids], start[:3], start[3:], lens.matrix, lens.distortion)
    jacobian = np.asarray(slopes)[:, :6]
    count = 2 * len(view.sighting.ids)
    noise = pose.rms**2 * len(view.sighting.ids) / max(count - 6, 1)
    covariance = noise * np.linalg.inv(jacobian.T @ jacobian)
    half = float(np.linalg.norm(ends[1] - ends[0])) / 2

    def plane(parameters: Array) -> Array:
        off = (ends - parameters[3:]) @ np.asarray(cv2.Rodrigues(parameters[:3])[0])[:, 2]
        return np.array((off.mean(), (off[1] - off[0]) / (2 * half)))

    gradient = np.column_stack([(plane(start + step) - plane(start - step)) / 2e-6 for step in 1e-6 * np.eye(6)])
    middle, slope = np.sqrt(np.diag(gradient @ covariance @ gradient.T)).tolist()
    return middle, slope


def residuals(parameters: Array, lines: Sequence[BoardLine], lidar: LidarPlace) -> Array:
    """Residuals between lines and planes, in standard deviations, shape (n, 2).

    Args:
        parameters: mount (``NAMES``), actual board size as a fraction of the stated size, and the lidar's range
            bias (m).
        lines: lines on the board.
        lidar: mount of the lidar.
    """
    mount, size, far = parameters[:6], parameters[6], parameters[7]
    ends = np.array([line.ends for line in lines])
    lengths = np.linalg.norm(ends, axis=2, keepdims=True)
    points = in_camera((ends * (1 - far / lengths)).reshape(-1, 3), mount, lidar).reshape(-1, 2, 3)
    normals = np.array([line.pose.axes[:, 2] for line in lines])
    places = np.array([line.pose.place for line in lines]) * size
    off = np.einsum("nik,nk->ni", points - places[:, None], normals)
    spans = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)
    both = np.column_stack((off.mean(axis=1), (off[:, 1] - off[:, 0]) / spans))
    return np.asarray(both / np.array([line.sigmas for line in lines]))


def fit(lines: Sequence[BoardLine], mount: Array, lidar: LidarPlace, size_error: float) -> FitResult:
    """Fit the mount by least squares; the parameters are those of ``residuals``.

    Args:
        lines: lines on the board.
        mount: initial guess.
        lidar: mount of the lidar.
        size_error: standard deviation of the board's relative size.
    """
    start = np.array((*mount, 1.0, 0.0))
    reach = np.array((*REACH, 0.5, 0.05))

    def residual(parameters: Array) -> Array:
        believed = ((parameters[6] - 1.0) / size_error, parameters[7] / ASSUMED.board_range)
        return np.concatenate((residuals(parameters, lines, lidar).ravel(), believed))

    return least_squares(residual, start, start - reach, start + reach)


def fit_mount(
    views: Sequence[BoardView], reader: BoardReader, lens: Lens, mount: Array, lidar: LidarPlace, focal_error: float
) -> tuple[FitResult, list[BoardLine]]:
    """Fit the camera's mount; return it with the lines used.

    Args:
        views: views of the board, with scans.
        reader: reader that found the boards.
        lens: lens of the camera.
        mount: configured mount.
        lidar: mount of the lidar.
        focal_error: relative standard deviation of the focal length, which has the same effect as the board's size.

    Raises:
        InputError: there are too few views, the board's size is wrong, or the views are inconsistent.
    """
    found = mount
    unknown = 0.3  # standard deviation before the lidar is used
    for known in (False, True):
        lines = [o for v in views if (o := line_on_board(v, reader, lens, found, lidar, known=known)) is not None]
        if len(lines) < LEAST_VIEWS:
            raise InputError(
                f"the lidar sees the board in {len(lines)} of {len(views)} views: expected {LEAST_VIEWS}; "
                "check that the configured mounts of lidar and camera are right to 10 cm and 10 degrees"
            )
        loose = fit(lines, found, lidar, unknown)
        lines = _agreeing(lines, loose, lidar)
        loose = fit(lines, loose.parameters[:6], lidar, unknown)
        found = loose.parameters[:6]
    _check_size(loose, reader.board)
    return fit(lines, found, lidar, math.hypot(ASSUMED.board_size, focal_error)), lines


def _agreeing(lines: list[BoardLine], found: FitResult, lidar: LidarPlace) -> list[BoardLine]:
    """Return the lines that agree with the fit; at most one view in five may be rejected as an outlier.

    Raises:
        InputError: there are more outliers.
    """
    off = np.abs(residuals(found.parameters, lines, lidar)).max(axis=1)
    # 5.0: minimum residual of an outlier, in standard deviations
    limit = 5.0 * max(1.0, float(np.median(off)))
    kept = [line for line, residual in zip(lines, off.tolist(), strict=True) if residual < limit]
    if len(kept) < max(LEAST_VIEWS, 0.8 * len(lines)):
        raise InputError(
            f"{len(lines) - len(kept)} of {len(lines)} views do not fit the others: the board is bent, or "
            "another object is in the lidar's view"
        )
    return kept


def _check_size(found: FitResult, board: BoardConfig) -> None:
    """Reject a board whose size, as measured by the lidar, differs from the stated size.

    Raises:
        InputError: the sizes differ.
    """
    size, sigma = float(found.parameters[6]), float(found.standard_errors[6])
    if abs(size - 1.0) > 0.01 + 3.0 * sigma:  # minimum relative error of the board's size for a report
        raise InputError(
            f"according to the lidar, the board is {size:.3f} times as large as stated: measure a square "
            f"({1000 * size * board.square:.1f} mm instead of {1000 * board.square:.1f}) and state "
            "--square and --marker"
        )
