"""From one scan to one estimate: preparation, mapping, and what is told about it."""

import math
from functools import partial
from typing import Any, Final, Protocol

import numpy as np
from numpy.typing import NDArray

from monstertruck_estimation.slam.config import MapperConfig
from monstertruck_estimation.slam.exchange import Estimate, Moved, Patch, ScanInput, Vector
from monstertruck_estimation.slam.frontend import FrontEnd, Match
from monstertruck_estimation.slam.increments import Increments
from monstertruck_estimation.slam.mapper import Event, Mapper
from monstertruck_estimation.slam.painter import Painter
from monstertruck_estimation.slam.scans import Scan, ScanGeometry, prepare
from monstertruck_estimation.slam.settings import GridConfig, SlamConfig
from monstertruck_estimation.slam.storage import Graph, graph_of
from monstertruck_estimation.slam.time_offset import OffsetWatch
from monstertruck_schemas.health import Standing

Array = NDArray[np.float64]

LOST_AFTER: Final = 10
"""Scans in a row that do not fit, after which the robot is lost."""
GROUND: Final = 0.05
"""Beams that end this near to ground or ceiling hit those, m."""
STEEPEST: Final = math.sin(math.radians(60))


class Estimator(Protocol):
    """What the worker drives: mapping, or localisation in a saved map."""

    counts: dict[str, int]
    """Scans, key scans, closures, rejected matches."""

    @property
    def twist(self) -> Vector:
        """Velocity of base by the last scans, m/s and rad/s."""
        ...

    def step(self, scan: Scan, inputs: ScanInput) -> Estimate | None:
        """Take a scan; None if it is not later than the one before."""
        ...

    def changes(self) -> tuple[list[Patch], bool]:
        """Tiles that have changed since the last call, and whether the grid was drawn anew."""
        ...

    def patch(self) -> Patch:
        """The whole grid."""
        ...

    def graph(self) -> Graph | None:
        """What can be saved beside the grid."""
        ...

    def finish(self) -> None:
        """Fit everything jointly."""
        ...


def prepared(inputs: ScanInput, longest: float, twist: Vector = (0.0, 0.0, 0.0)) -> Scan:
    """Points of a scan in base: motion undone, levelled, without what hit the ground or the ceiling.

    Args:
        inputs: the scan.
        longest: longer ranges are not used, m.
        twist: of the base, m/s and rad/s, if odometry does not tell it.
    """
    geometry = ScanGeometry(
        inputs.start_angle,
        inputs.angle_increment,
        inputs.range_min,
        inputs.range_max,
        inputs.time_increment,
        inputs.mount,
    )
    return prepare(levelled(inputs), geometry, twist if inputs.odom is None else inputs.twist, longest)


def levelled(inputs: ScanInput) -> Array:
    """Ranges in the horizontal; NaN where a beam met the ground or the ceiling.

    A beam at angle a rises by cos(a) sx + sin(a) sy a metre, with the ``slopes`` (sx, sy) of the sensor's axes.
    """
    ranges = np.asarray(inputs.ranges, dtype=np.float64)
    if inputs.slopes is None:
        return ranges
    angles = inputs.start_angle + inputs.angle_increment * np.arange(len(ranges))
    rise = np.clip(np.cos(angles) * inputs.slopes[0] + np.sin(angles) * inputs.slopes[1], -STEEPEST, STEEPEST)
    result: Array = ranges * np.sqrt(1.0 - rise**2)
    # Levelling must not turn a no-return just beyond the limit into a range.
    result[~(ranges < inputs.range_max)] = np.inf
    if inputs.height is not None:
        with np.errstate(invalid="ignore"):
            ends = inputs.height + ranges * rise
            hit = ends < GROUND
            if inputs.ceiling is not None:
                hit |= ends > inputs.ceiling - GROUND
        result[hit] = np.nan
    return result


class _Anchored(Mapper):
    """A mapper whose first pose is not the map's origin."""

    def __init__(self, config: MapperConfig, front: FrontEnd | None, start: Vector) -> None:
        super().__init__(config, front)
        self._pose = np.array(start, dtype=np.float64)


class MappingEstimator:
    """The mapper with its grid.

    Args:
        mapper: noise models and limits.
        grid: of the occupancy grid.
        front: scan front end; None = the default one.
        start: base in map at the first scan.
    """

    def __init__(
        self, mapper: MapperConfig, grid: GridConfig, front: FrontEnd | None = None, start: Vector = (0.0, 0.0, 0.0)
    ) -> None:
        self.mapper = _Anchored(mapper, front, start)
        self.painter = Painter(grid)
        self.counts = {"scans": 0, "keys": 0, "closures": 0, "rejected": 0}
        self._moved = False
        self._redrawn = False
        self._misfits = 0
        self._offset = OffsetWatch()
        self._increments = Increments()

    @property
    def twist(self) -> Vector:
        """See ``Estimator``."""
        return self.mapper.twist

    def step(self, scan: Scan, inputs: ScanInput) -> Estimate | None:
        """See ``Estimator``."""
        odom = None if inputs.odom is None else np.array(inputs.odom)
        swept = odom is None and inputs.time_increment > 0
        again = partial(prepared, inputs, self.mapper.config.longest) if swept else None
        period = inputs.time_increment * math.tau / inputs.angle_increment if swept else 0.0
        step = self.mapper.step(scan, inputs.stamp, odom, again, period)
        if step is None:
            return None
        accepted = step.match.accepted or (Event.KEY in step.events and len(self.mapper.map) == 1)
        self._misfits = 0 if accepted else self._misfits + 1
        self.counts["scans"] += 1
        self.counts["keys"] = len(self.mapper.map)
        self.counts["closures"] += Event.CLOSED in step.events
        self.counts["rejected"] += Event.REJECTED in step.events
        self._moved |= Event.CLOSED in step.events
        if accepted:
            self.painter.add(step.scan, step.stamp, step.pose, inputs.mount)
            if inputs.odom is not None:
                self._offset.add(step.stamp, float(step.pose[2]), inputs.odom[2])
        closed = Event.CLOSED in step.events
        moved = self._increments.take(step.stamp, step.match, step.pose, alone=inputs.odom is None, corrected=closed)
        standing = Standing.LOST if self._misfits >= LOST_AFTER else standing_of(step.match, Standing.MAPPING)
        return estimate(
            step.stamp,
            (step.pose, step.covariance, step.map_from_odom),
            step.match,
            standing,
            tuple(map(str, step.events)),
            self._offset.offset,
            moved,
        )

    def changes(self) -> tuple[list[Patch], bool]:
        """See ``Estimator``."""
        self._follow()
        redrawn, self._redrawn = self._redrawn, False
        return self.painter.grid.changes(), redrawn

    def patch(self) -> Patch:
        """See ``Estimator``."""
        self._follow()
        return self.painter.grid.patch()

    def graph(self) -> Graph | None:
        """See ``Estimator``."""
        return graph_of(self.mapper)

    def finish(self) -> None:
        """See ``Estimator``."""
        self.mapper.finish()
        self._moved = True

    def _follow(self) -> None:
        if self._moved:
            self._moved = False
            self._redrawn |= self.painter.follow(*self.mapper.trajectory())


def standing_of(match: Match, good: Standing) -> Standing:
    """``good``, unless the match says nothing along one direction."""
    return Standing.DEGENERATE if match.accepted and match.degenerate else good


def estimate(
    stamp: int,
    placed: tuple[Array, Array, Array | None],
    match: Match,
    standing: Standing,
    events: tuple[str, ...],
    offset: float | None,
    moved: Moved | None = None,
) -> Estimate:
    """Plain numbers of a match; ``placed`` are pose, covariance and odom in map."""
    pose, covariance, correction = placed
    return Estimate(
        stamp=stamp,
        pose=plain(pose),
        covariance=tuple(float(value) for value in covariance.ravel()),
        map_from_odom=None if correction is None else plain(correction),
        standing=standing,
        overlap=match.overlap,
        residual=match.residual,
        degeneracy=match.degeneracy,
        direction=match.direction,
        verdict=str(match.verdict),
        events=events,
        offset=offset,
        moved=moved,
    )


def plain(pose: Any) -> Vector:
    """A pose as three floats."""
    x, y, yaw = (float(value) for value in pose)
    return x, y, yaw


def mapper_config(config: SlamConfig) -> MapperConfig:
    """The mapper's part of the configuration."""
    return MapperConfig(**dict(config.mapper))
