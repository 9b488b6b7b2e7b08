"""Field of view of a lidar: a beam without a range may mean free ground, or a covered or dazzled sensor."""

import math
from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from monstertruck_kinematics.elementary import Array
from monstertruck_planners.collision import Footprint, on_body
from monstertruck_schemas.sensor import HIDDEN, NO_ECHO, VALID_BEAM, LaserScan

SECTORS: Final = 36
"""Number of sectors around the lidar: 0.1 m wide at the end of the checked distance, narrower than the body."""

Sectors = NDArray[np.intp]


class Visibility:
    """When each sector around the lidar was last seen.

    A beam is valid if its range ends outside the body, or if it has no return within the sensor's range. A sector is
    seen if enough of its beams are valid, because single beams fail on edges and dark surfaces.

    Args:
        footprint: the body's outline.
        mount: pose (x, y, yaw) of the lidar in base, m, m, rad.
        share: minimum fraction of valid beams in a seen sector, 0..1.
    """

    def __init__(self, footprint: Footprint, mount: tuple[float, float, float], share: float) -> None:
        self._footprint = footprint
        self._mount = mount
        self._share = share
        self._geometry: tuple[float, float, bytes] | None = None
        self._sector_of_beam: Sectors = np.empty(0, np.intp)
        self._beams: Array = np.zeros(SECTORS)
        self._field: NDArray[np.bool_] = np.zeros(SECTORS, np.bool_)
        self._seen_at: NDArray[np.int64] = np.zeros(SECTORS, np.int64)

    def observe(self, scan: LaserScan, points: Array) -> None:
        """Take a scan.

        Args:
            scan: the revolution.
            points: valid returns of the scan in base, ``scan_points``, shape (n, 2), m.
        """
        shown = scan.codes != HIDDEN
        geometry = scan.start_angle, scan.angle_increment, shown.tobytes()
        if geometry != self._geometry:
            self._geometry = geometry
            start, increment, _ = geometry
            self._sector_of_beam = _sector(start + increment * np.arange(len(shown), dtype=np.float64))
            self._beams = np.bincount(self._sector_of_beam, weights=shown, minlength=SECTORS).astype(np.float64)
            present = 0.5  # minimum fraction of a sector's beams in a scan for the sector to be in the field of view
            self._field = self._beams * abs(increment) > present * math.tau / SECTORS
        sees = scan.codes <= NO_ECHO
        sees[((scan.codes == VALID_BEAM) & np.isfinite(scan.ranges)).nonzero()[0]] = ~on_body(
            self._footprint, points, 0.0
        )
        seen = np.bincount(self._sector_of_beam, weights=sees, minlength=SECTORS) >= self._share * self._beams
        self._seen_at[seen & self._field] = scan.stamp

    def sectors_of(self, points: Array) -> Sectors:
        """Sector of every point (n, 2) in base (m)."""
        x, y, yaw = self._mount
        return _sector(np.arctan2(points[:, 1] - y, points[:, 0] - x) - yaw)

    def covers(self, points: Array) -> NDArray[np.bool_]:
        """Return whether each point (n, 2) in base (m) lies in the lidar's field of view."""
        return self._field[self.sectors_of(points)]

    def last_seen(self, sectors: Sectors) -> NDArray[np.int64]:
        """Time each sector was last seen, ns; 0 for never, -1 outside the lidar's field of view."""
        return np.where(self._field[sectors], self._seen_at[sectors], -1)

    def age(self, points: Array, now: int) -> NDArray[np.int64]:
        """Time since the sector of every point (n, 2) in base was last seen (ns)."""
        return now - self._seen_at[self.sectors_of(points)]


def travelled(views: Sequence[Visibility], body: Footprint, ground: Array) -> Sectors:
    """Sectors of the points (n, 2) in base (m) that are not under the body, by lidar.

    Returns:
        Shape (lidars, m): every combination of sectors once.
    """
    margin = 0.005  # ground this near to the body counts as under it, m
    outside = ground[~on_body(body, ground, margin)]
    return np.unique(np.stack([view.sectors_of(outside) for view in views]), axis=1)


def _sector(bearings: Array) -> Sectors:
    return ((bearings + math.pi) // (math.tau / SECTORS)).astype(np.intp) % SECTORS
