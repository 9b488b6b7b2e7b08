"""Sonars computed from a lidar: ranges along axes fixed to the robot, as ``sensor/sonar``, for a robot without sonars.

Scan points are joined where neighbouring beams hit the same surface. Each axis, a narrow beam from the sonar's
position, is intersected with these surfaces. Behaviours that follow walls by sonars can then drive a robot that has
only a lidar.
"""

import math
from typing import Annotated, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from monstertruck_kinematics.beams import is_full_turn, nearest_beams
from monstertruck_kinematics.elementary import Array
from monstertruck_kinematics.se2 import points_relative
from monstertruck_runtime.clock import SECOND, Clock
from monstertruck_runtime.mailbox import Mailbox
from monstertruck_runtime.ports import Publisher, Ready
from monstertruck_schemas.base import FrameId, Schema
from monstertruck_schemas.body import Mount
from monstertruck_schemas.roles import ServiceName
from monstertruck_schemas.sensor import NO_ECHO, VALID_BEAM, LaserScan, SonarEcho, SonarRanges


def places() -> dict[str, Mount]:
    """Return mounts for left, front left, front, front right and right; the diagonals 0.05 m ahead of the others."""
    return {
        "l": Mount(x=0.05, y=0.05, yaw=math.pi / 2),
        "fl": Mount(x=0.10, y=0.05, yaw=math.pi / 4),
        "f": Mount(x=0.12),
        "fr": Mount(x=0.10, y=-0.05, yaw=-math.pi / 4),
        "r": Mount(x=0.05, y=-0.05, yaw=-math.pi / 2),
    }


class LidarSonarsConfig(Schema):
    """Settings of sonars computed from lidar scans."""

    sonars: dict[FrameId, Mount] = Field(default_factory=places, min_length=1)
    """Position and axis of each sonar in the base frame, by name"""
    range_min: Annotated[float, Field(ge=0, lt=5)] = 0.02
    """Minimum reported range, m"""
    range_max: Annotated[float, Field(gt=0, le=30)] = 3.0
    """Maximum range, m"""

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        if self.range_min >= self.range_max:
            raise ValueError(f"range_min {self.range_min} m: expected less than range_max, {self.range_max} m")
        return self


def sonars_of(scan: LaserScan, mount: tuple[float, float, float], config: LidarSonarsConfig) -> tuple[SonarEcho, ...]:
    """Return the sonar ranges; a sonar has not answered if its axis lies where the lidar cannot see or has no data.

    Args:
        scan: lidar scan.
        mount: pose of the lidar in base (m, m, rad).
        config: settings of the sonars.
    """
    bearings = scan.start_angle + scan.angle_increment * np.arange(len(scan.ranges))
    valid = (scan.codes == VALID_BEAM) & np.isfinite(scan.ranges)
    ranges = np.where(valid, scan.ranges, 0.0)
    points = np.column_stack([
        mount[0] + ranges * np.cos(mount[2] + bearings),
        mount[1] + ranges * np.sin(mount[2] + bearings),
    ])  # fmt: skip
    around = np.resize(np.arange(len(ranges)), len(ranges) + bool(len(ranges)))  # to the first beam again
    apart = np.hypot(*np.diff(points[around], axis=0).T)
    # 0.15: greatest distance of neighbouring points of one surface, m, and its share of their range, where that is more
    joined = valid & valid[around[1:]] & (apart <= np.maximum(0.15, 0.1 * ranges[around[1:]]))
    if not is_full_turn(len(ranges), scan.angle_increment):
        joined[-1:] = False
    known = valid | (scan.codes <= NO_ECHO)
    echoes = []
    for name, place in config.sonars.items():
        found, beam = _cut(points[around], joined, place)
        if beam is None:
            beam = _beam_towards(scan, mount, place, config.range_max)
        answered = beam is not None and bool(known[beam])
        near = found is not None and found <= config.range_max
        late = 0 if beam is None else round(beam * scan.time_increment * SECOND)
        measured = max(found, config.range_min) if found is not None and near else None
        echoes.append(SonarEcho(name=name, answered=answered, range=measured, stamp=scan.stamp + late))
    return tuple(echoes)


def _cut(points: Array, joined: NDArray[np.bool_], place: Mount) -> tuple[float, int] | tuple[None, None]:
    """Return the range of the axis's first intersection (m) and the number of the beam before; None without one."""
    along, aside = points_relative(points, (place.x, place.y, place.yaw)).T
    crossing = joined & (aside[:-1] * aside[1:] <= 0.0) & (aside[:-1] != aside[1:])
    at = crossing.nonzero()[0]
    share = aside[at] / (aside[at] - aside[at + 1])
    cuts = along[at] + share * (along[at + 1] - along[at])
    ahead = cuts > 0.0
    if not ahead.any():
        return None, None
    best = int(np.argmin(np.where(ahead, cuts, np.inf)))
    return float(cuts[best]), int(at[best])


def _beam_towards(scan: LaserScan, mount: tuple[float, float, float], place: Mount, reach: float) -> int | None:
    """Return the number of the lidar beam to the far end of a sonar axis; None if outside the lidar's field of view."""
    x, y = place.x + reach * math.cos(place.yaw) - mount[0], place.y + reach * math.sin(place.yaw) - mount[1]
    bearing = np.array([math.atan2(y, x) - mount[2]])
    beam = int(nearest_beams(bearing, scan.start_angle, scan.angle_increment)[0])
    return beam if beam < len(scan.ranges) else None


class LidarSonars:
    """Service that publishes ``sensor/sonar`` for every scan.

    Args:
        config: settings of the sonars.
        mount: pose of the lidar in base (m, m, rad).
        clock: clock.
        scans: subscription to ``sensor/scan``.
        out: publisher of ``sensor/sonar``.
    """

    name = ServiceName.LIDAR_SONARS.value

    def __init__(
        self,
        config: LidarSonarsConfig,
        mount: tuple[float, float, float],
        clock: Clock,
        scans: Mailbox[LaserScan],
        out: Publisher[SonarRanges],
    ) -> None:
        self._config, self._mount, self._clock, self._scans, self._out = config, mount, clock, scans, out

    async def run(self, ready: Ready) -> None:
        """Serve until cancelled."""
        ready()
        async for scan in self._scans:
            self._out.put(
                SonarRanges(
                    stamp=scan.stamp,
                    received=self._clock.now(),
                    seq=self._out.next_seq(),
                    sonars=sonars_of(scan, self._mount, self._config),
                    field_of_view=0.01,  # opening angle that the messages state, rad: that of a beam
                    range_min=self._config.range_min,
                    range_max=self._config.range_max,
                )
            )
