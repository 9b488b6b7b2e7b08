"""Messages of the map from what the estimation worker gives."""

from collections.abc import Mapping

import numpy as np

from monstertruck_estimation.slam.exchange import Estimate, Moved, Patch
from monstertruck_schemas.base import Pose2D
from monstertruck_schemas.health import SlamHealth
from monstertruck_schemas.state import Grid, ScanMotion


def grid_message(patch: Patch, now: int, seq: int) -> Grid:
    """A patch of the map as a grid of its own."""
    rows, columns = patch.cells.shape
    cells = np.ascontiguousarray(patch.cells).reshape(-1)
    cells.flags.writeable = False
    x, y = patch.origin
    return Grid(
        stamp=now,
        received=now,
        seq=seq,
        frame="map",
        resolution=patch.resolution,
        width=columns,
        height=rows,
        origin=Pose2D(x=x, y=y, yaw=0.0),
        cells=cells,
    )


def scan_motion(stamp: int, moved: Moved, now: int, seq: int) -> ScanMotion:
    """Motion of base between two scans."""
    x, y, yaw = moved.motion
    return ScanMotion(
        stamp=stamp,
        received=now,
        seq=seq,
        frame="base",
        since=moved.since,
        motion=Pose2D(x=x, y=y, yaw=yaw),
        covariance=np.array(moved.covariance),
    )


def slam_health(estimate: Estimate, counts: Mapping[str, int], lost: tuple[int, int], now: int, seq: int) -> SlamHealth:
    """How the newest scan fitted; ``lost`` are the scans left out and those dropped."""
    return SlamHealth(
        stamp=estimate.stamp,
        received=now,
        seq=seq,
        frame="map",
        standing=estimate.standing,
        accepted=estimate.verdict == "accepted",
        overlap=min(max(estimate.overlap, 0.0), 1.0),
        residual=estimate.residual,
        degeneracy=estimate.degeneracy,
        direction=estimate.direction,
        scans=counts["scans"],
        keys=counts["keys"],
        closures=counts["closures"],
        rejected=counts["rejected"],
        left_out=lost[0],
        drops=lost[1],
        offset=estimate.offset,
    )
