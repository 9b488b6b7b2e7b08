"""Quality of a map built from a log: lost poses, use of odometry along the path, rejected matches."""

import itertools
import math
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from monstertruck_estimation.slam.worker_io import ScanInput, SlamEstimate
from monstertruck_kinematics.elementary import Array
from monstertruck_schemas.health import LocalisationStatus

MATCHED = "accepted"
"""Verdict on an accepted match."""
REJECTED = "rejected"
"""Event of a scan whose match was rejected."""


@dataclass(frozen=True, slots=True)
class PathQuality:
    """Path of a finished map, and the fraction that is lost."""

    lost: NDArray[np.bool_]
    """Shape (n,): which poses of the trajectory are lost."""
    length: float
    """Length of the path (m)."""
    lost_share: float
    """Fraction of the path that is lost, 0..1."""
    odometry: dict[str, float]
    """Fraction of the path between used scans by ``OdometryUse``, 0..1."""

    @classmethod
    def of(
        cls,
        trajectory: tuple[NDArray[np.int64], Array],
        on_map: NDArray[np.bool_],
        estimates: Iterable[SlamEstimate],
        scans: Sequence[ScanInput],
    ) -> Self:
        """Evaluate a path.

        A pose is lost if its scan belongs to a submap that is not joined to the map, or matched nothing while the robot
        was lost. The path between two poses is lost if the later one is. The odometry distance after the last used scan
        is lost as well.

        Args:
            trajectory: stamps (n,), ns, and poses (n, 3) of base in map.
            on_map: shape (n,), whether each pose belongs to the map.
            estimates: estimates of the scans, in the order of processing.
            scans: all scans of the log.
        """
        stamps, poses = trajectory
        made = {estimate.stamp: estimate for estimate in estimates}
        then = [made[stamp] for stamp in stamps.tolist()]
        lost = ~on_map | np.array([_misfit(estimate) for estimate in then], bool)
        steps = np.hypot(*np.diff(poses[:, :2], axis=0, prepend=poses[:1, :2]).T)
        unused = _after(scans, made)
        length = float(steps.sum()) + unused
        by_use: Counter[str] = Counter()
        for estimate, step in zip(then, steps.tolist(), strict=True):
            by_use[estimate.odometry.value] += step
        return cls(
            lost,
            length,
            (float(steps[lost].sum()) + unused) / length if length else 0.0,
            {use: step / float(steps.sum()) for use, step in by_use.items() if step},
        )


def verdicts(estimates: Iterable[SlamEstimate]) -> dict[str, int]:
    """Count the rejected matches by verdict, the most frequent first."""
    return dict(Counter(one.verdict for one in estimates if REJECTED in one.events).most_common())


def _misfit(estimate: SlamEstimate) -> bool:
    return estimate.status is LocalisationStatus.LOST and estimate.verdict != MATCHED


def _after(scans: Sequence[ScanInput], made: dict[int, SlamEstimate]) -> float:
    """Return the odometry distance from the last used scan to the end of the log (m)."""
    last = max(made)
    rest = itertools.dropwhile(lambda scan: scan.stamp != last, scans)
    places = [scan.odom[:2] for scan in rest if scan.odom is not None]
    return sum(math.dist(before, after) for before, after in itertools.pairwise(places))
