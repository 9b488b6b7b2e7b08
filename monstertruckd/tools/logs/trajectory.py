"""Trajectories as text of the TUM or KITTI benchmark, a line per scan.

TUM: ``t x y z qx qy qz qw``, metres and seconds. KITTI: the matrix of base in map, 3 x 4, row by row, without times.

A scan's stamp, and the pose estimated for it, are of its first beam. Drawing a whole scan at one pose, and comparing
poses with another system, need the middle: so each line has the time of the middle of the sweep, by the clock of the
log, and the pose at that time (between the poses of neighbouring scans).
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
    """Poses, shape (n, 3), ``delay`` seconds after each stamp; after the last one the last motion continues.

    Args:
        stamps: shape (n,), s, rising.
        poses: shape (n, 3), at ``stamps``.
        delay: s, not negative.
    """
    if delay <= 0 or len(stamps) < 2:
        return poses
    onward = compose(poses[-1], between(poses[-2], poses[-1]))
    times = np.append(stamps, 2 * stamps[-1] - stamps[-2])
    return interpolate(times, np.vstack((poses, onward)), stamps + delay)


def tum(time: float, x: float, y: float, yaw: float) -> str:
    """A line of the TUM benchmark."""
    return f"{time:.6f} {x:.6f} {y:.6f} 0 0 0 {math.sin(yaw / 2):.9f} {math.cos(yaw / 2):.9f}\n"


def kitti(time: float, x: float, y: float, yaw: float) -> str:
    """A line of the KITTI benchmark, in our axes: x forward, z up."""
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
    """Write poses of a log's scans; list lost ones in a second file (``poses.lost.txt``, TUM; empty if none is).

    Args:
        path: path of the file.
        stamps: shape (n,), ns, of the scans' first beams.
        poses: shape (n, 3), base in map at ``stamps``.
        log: where the scans are from.
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
