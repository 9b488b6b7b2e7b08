"""Lidars mounted differently than configured, in a minute of drawn logs (``drawn``): turned, mirrored, late.

A correct mount and synchronous clocks must not be reported; a wrong mount must be reported within the minute, with its
yaw and the offset of the clocks.
"""

import math
from pathlib import Path

import numpy as np

from benchmarks.slam_parts.drawn import PERIOD, over_drives
from monstertruck_estimation.slam.config import GridConfig, MapperConfig
from monstertruck_estimation.slam.mapping import MappingEstimator
from monstertruck_estimation.slam.mount import mount_of
from monstertruck_estimation.slam.scans import prepare_input
from monstertruck_estimation.slam.worker_io import ScanInput

KINDS = ("right", "2", "-5", "10", "mirrored", "late")
"""Turned by degrees, beams in reverse, or seen ``PERIOD`` seconds later than stamped."""
SCANS = round(60.0 / PERIOD)
SEEDS = 5
YAW, OFFSET = 0.3, 0.01
"""Greatest errors of the yaw, degrees, and of the offset, s."""


def run(folder: Path, *, quick: bool) -> tuple[dict[str, float], dict[str, float], bool]:
    """Return figures, goals, and whether all are met."""
    return over_drives(
        folder, "mounts", 1 if quick else SEEDS, lambda log, *_: ((kind, *mounted(log, kind)) for kind in KINDS)
    )


def mounted(log: tuple, kind: str) -> tuple[dict[str, float], dict[str, float]]:
    """Return figures and goals of one drive."""
    stamps, ranges, odometry, _, geometry = log
    yaw = math.radians(float(kind)) if kind.lstrip("-").isdigit() else 0.0
    turns, late = (-1 if kind == "mirrored" else 1), int(kind == "late")
    estimator, scans, estimates = MappingEstimator(MapperConfig(), GridConfig()), [], []
    for k in range(SCANS):
        inputs = ScanInput(
            int(stamps[k]) + 1,
            ranges[k][::turns],
            geometry.start_angle - yaw,
            geometry.angle_increment,
            geometry.range_min,
            geometry.range_max,
            odom=tuple(odometry[k + late].tolist()),
        )
        estimate = estimator.step(prepare_input(inputs, MapperConfig().longest), inputs)
        assert estimate is not None
        scans.append(inputs)
        estimates.append(estimate)
    found = mount_of(scans, estimator.trajectory())
    assert found is not None
    reported = float(np.mean([estimate.mount_fault is not None for estimate in estimates]))
    offsets = [estimate.offset for estimate in estimates if estimate.offset is not None]
    figures = {
        "yaw_error_deg": math.degrees(abs(found.yaw - yaw)),
        "deviation_deg": math.degrees(found.deviation),
        "unreported": 1.0 - reported if yaw or kind == "mirrored" else reported,
        "offset_error_s": abs((offsets[-1] if offsets else 0.0) - late * PERIOD),
    }
    return figures, {
        "yaw_error_deg": YAW,
        "unreported": 0.99 if yaw or kind == "mirrored" else 0.0,
        "offset_error_s": OFFSET,
    }
