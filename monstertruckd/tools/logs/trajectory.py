"""Trajectories in the text format of the TUM or KITTI benchmark, one line per scan.

TUM: ``t x y z qx qy qz qw``, metres and seconds. KITTI: the matrix of base in map, 3 x 4, row by row, without times.

A scan's stamp and estimated pose are those of its first beam. Drawing a whole scan at one pose, or comparing poses with
another system, requires the middle of the sweep. Each line therefore has the time of the mid-sweep on the log's clock
and the pose interpolated to it.
"""

import itertools
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from monstertruck_kinematics.elementary import Array
from monstertruck_kinematics.se2 import between, compose, interpolate
from monstertruck_runtime.clock import SECOND
from monstertruck_runtime.small_files import replace_file
from monstertruckd.tools.logs.scan_log import ScanLog


def mid_sweep(stamps: Array, poses: Array, delay: float) -> Array:
    """Return the poses ``delay`` seconds after each stamp, shape (n, 3); the last motion is extrapolated.

    Args:
        stamps: shape (n,), increasing (s).
        poses: shape (n, 3), at ``stamps``.
        delay: delay, not negative (s).
    """
    if delay <= 0 or len(stamps) < 2:
        return poses
    onward = compose(poses[-1], between(poses[-2], poses[-1]))
    times = np.append(stamps, 2 * stamps[-1] - stamps[-2])
    return interpolate(times, np.vstack((poses, onward)), stamps + delay)


def tum(time: float, x: float, y: float, yaw: float) -> str:
    """Return a line in TUM format."""
    return f"{time:.6f} {x:.6f} {y:.6f} 0 0 0 {math.sin(yaw / 2):.9f} {math.cos(yaw / 2):.9f}\n"


def kitti(time: float, x: float, y: float, yaw: float) -> str:
    """Return a line in KITTI format, with x forward and z up."""
    c, s = math.cos(yaw), math.sin(yaw)
    return f"{c:.9f} {-s:.9f} 0 {x:.6f} {s:.9f} {c:.9f} 0 {y:.6f} 0 0 1 0\n"


Line = Callable[[float, float, float, float], str]
"""Writes a line from time (s), x, y (m) and yaw (rad)."""
LINES: Final[dict[str, Line]] = {"tum": tum, "kitti": kitti}
"""Formats by name."""


def write_trajectory(
    path: Path,
    stamps: Sequence[int] | NDArray[np.int64],
    poses: Array | Sequence[object],
    log: ScanLog,
    lost: NDArray[np.bool_] | None = None,
    *,
    lines: Line = tum,
) -> str:
    """Write the poses of a log's scans, and the lost ones to a second file (``poses.lost.txt``, TUM; may be empty).

    Args:
        path: path of the file.
        stamps: times of the scans' first beams, shape (n,) (ns).
        poses: shape (n, 3), base in map at ``stamps``.
        log: log of the scans.
        lost: shape (n,), mask of lost poses; None writes no second file.
        lines: format of the first file.

    Returns:
        Description of the files written.

    Raises:
        OSError: the file cannot be written.
    """
    first = log.scans[0]
    delay = first.time_increment * len(first.ranges) / 2
    seconds = np.asarray(stamps, np.int64) / SECOND
    middle = mid_sweep(seconds, np.asarray(poses, np.float64).reshape(-1, 3), delay)
    rows = [
        (log.begin + second + delay, x, y, yaw)
        for second, (x, y, yaw) in zip(seconds.tolist(), middle.tolist(), strict=True)
    ]
    replace_file(path, "".join(lines(*row) for row in rows))
    said = f"{path}, {len(rows)} poses, each {delay:g} s after its scan's stamp"
    if lost is None:
        return said
    second = path.with_name(f"{path.stem}.lost{path.suffix}")
    replace_file(second, "".join(tum(*row) for row in itertools.compress(rows, lost.tolist())))
    return f"{said}; {np.count_nonzero(lost)} lost poses, listed in {second}"
