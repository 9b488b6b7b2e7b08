"""How a lidar is mounted on its robot: upside down, or behind parts that hide sectors.

The beam at bearing b of a lidar turned by pi about its x axis points in the same direction as the beam at -b of an
upright lidar.
"""

import math
from collections.abc import Sequence

import numpy as np

from monstertruck_runtime.ports import Publisher
from monstertruck_schemas.body import Mount
from monstertruck_schemas.sensor import HIDDEN, LaserScan


def hangs(mount: Mount) -> bool:
    """Whether a lidar is mounted upside down."""
    return abs(mount.roll) > math.pi / 2


def upright(mount: Mount) -> Mount:
    """Return the mount of an upright lidar with the same measurements."""
    return mount.model_copy(update={"roll": math.remainder(mount.roll - math.pi, math.tau)}) if hangs(mount) else mount


def turned_by_roll(mount: Mount) -> Mount:
    """Return the same orientation as the other Euler-angle solution, with roll and yaw changed by half a turn."""
    half_turn = {name: math.remainder(getattr(mount, name) + math.pi, math.tau) for name in ("roll", "yaw")}
    return mount.model_copy(update={**half_turn, "pitch": math.remainder(math.pi - mount.pitch, math.tau)})


class MountedScans:
    """Publisher that converts scans to those of an upright lidar and masks hidden beams.

    Args:
        out: scan publisher.
        mount: the lidar's mount.
        hidden: hidden sectors, each as its first and last bearing, counter-clockwise (rad).
    """

    def __init__(self, out: Publisher[LaserScan], mount: Mount, hidden: Sequence[tuple[float, float]]) -> None:
        self._out, self._hangs, self._hidden = out, hangs(mount), hidden

    def next_seq(self) -> int:
        """Sequence number for the next scan."""
        return self._out.next_seq()

    def put(self, message: LaserScan) -> None:
        """Publish a scan."""
        if self._hangs:
            turned = {"start_angle": -message.start_angle, "end_angle": -message.end_angle}
            message = message.model_copy(update=turned)
        if self._hidden:
            bearings = message.start_angle + message.angle_increment * np.arange(len(message.ranges))
            hidden = np.zeros(len(bearings), np.bool_)
            for first, last in self._hidden:
                hidden |= np.remainder(bearings - first, math.tau) <= (last - first) % math.tau
            ranges, codes = np.where(hidden, np.inf, message.ranges), np.where(hidden, np.uint8(HIDDEN), message.codes)
            message = message.model_copy(update={"ranges": ranges, "codes": codes})
        self._out.put(message)
