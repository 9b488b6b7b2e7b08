"""Points of interest from tag readings (pure); a point is stored relative to a pose, so it moves with the map.

Every sighting keeps its place in the robot's base and the stamp of its image. After every correction, the tracker asks
the mapper for the robot's pose at that stamp, so that sightings from before and after a loop agree once the loop is
closed.
"""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from monstertruck_estimation.points.config import PointsConfig
from monstertruck_estimation.points.exchange import TagReading, Triple
from monstertruck_estimation.vision.mount import camera_axes
from monstertruck_kinematics.elementary import Array
from monstertruck_kinematics.se2 import Pose2, between, compose
from monstertruck_schemas.body import Mount
from monstertruck_schemas.points import PointKind, PointOfInterest

KEPT_SIGHTINGS: Final = 24
"""Maximum number of sightings per point."""


@dataclass(frozen=True, slots=True)
class PointSighting:
    """A point's pose relative to the robot at one instant."""

    stamp: int
    """Stamp of the image (ns)."""
    base: Pose2
    """Robot in map at that stamp, as known at the time."""
    place: Triple
    """Place in base (m)."""
    yaw: float
    """Direction that the point faces, in base (rad)."""
    spread: tuple[float, ...]
    """Covariance of x, y, yaw in base, row-major (3, 3)."""
    worth: int = 1
    """Number of sightings that it stands for."""


@dataclass(frozen=True, slots=True)
class Tracked:
    """A point, published or not."""

    name: str
    kind: PointKind
    tag: int | None
    size: float | None
    sightings: tuple[PointSighting, ...]
    count: int
    """Number of images so far."""
    first: int
    last: int
    picture: bytes = b""
    sharpest: float = 0.0
    """Side of the tag in the sharpest image (pixels)."""


Bases = Mapping[int, Pose2]
"""Poses of the robot by stamp, in the current map."""
PoseAsker = Callable[[tuple[int, ...]], Bases]
"""Ask the mapper for the robot's poses at several stamps; return those known so far."""


@dataclass
class PointMap:
    """All points of a map.

    Args:
        config: gates.
        mount: mount of the camera.
    """

    config: PointsConfig
    mount: Mount
    points: dict[str, Tracked] = field(default_factory=dict)
    shown: dict[str, PointOfInterest] = field(default_factory=dict)
    """State of each point at its last ``refresh``."""

    def see(self, reading: TagReading, stamp: int, base: Pose2, covariance: Array, rate: float) -> bool:
        """Take a reading; return whether it made a tag a point of interest.

        Args:
            reading: reading from an image.
            stamp: stamp of the image (ns).
            base: robot in map at that stamp.
            covariance: covariance of that pose, (3, 3).
            rate: turn rate of the robot (rad/s).
        """
        name = f"tag-{reading.tag}"
        known = self.points.get(name)
        if known is None and len(self.points) >= self.config.most:
            return False
        # Stamps in a saved map are from the clock of an earlier start.
        # 100_000_000: minimum time between two images that are used, ns
        if known is not None and abs(stamp - known.last) < 100_000_000:
            return False
        new = sighting(reading, self.mount, stamp, base, covariance, rate)
        before = known is not None and self.is_known(known)
        if known is None:
            size = self.config.sizes.get(reading.tag, self.config.size)
            known = Tracked(name, PointKind.TAG, reading.tag, size, (), 0, stamp, stamp)
        known = replace(known, sightings=_added(known.sightings, new), count=known.count + 1, last=stamp)
        if reading.picture and reading.pixels > 1.1 * known.sharpest:
            known = replace(known, picture=reading.picture, sharpest=reading.pixels)
        self.points[name] = known
        return not before and self.is_known(known)

    def is_known(self, point: Tracked) -> bool:
        """Whether enough images agree on a point."""
        if point.kind is PointKind.MARK:
            return True
        needed = self.config.sightings
        return point.count >= needed and (len(point.sightings) == 1 or _consensus(point.sightings, {}, self.config) > 1)

    def mark(self, name: str, stamp: int, base: Pose2, place: Pose2, covariance: Array) -> None:
        """Mark a place by name, on behalf of an operator.

        Args:
            name: name of the place; an existing one is moved.
            stamp: an instant when the robot was near it (ns).
            base: robot in map at that instant.
            place: place to mark, in map.
            covariance: covariance of the robot's pose, (3, 3).
        """
        x, y, yaw = between(np.array(base), np.array(place)).tolist()
        into = _into_base(base)
        # 0.01: standard deviation of a place marked by an operator, m and rad
        spread = tuple(float(v) for v in (into @ covariance @ into.T + np.eye(3) * 0.01**2).ravel())
        one = PointSighting(stamp, base, (x, y, 0.0), yaw, spread)
        self.points[name] = Tracked(name, PointKind.MARK, None, None, (one,), 0, stamp, stamp)

    def anchor(self, name: str, base: Pose2) -> None:
        """Keep a mark at its place in the map: in the current map the robot was at ``base`` at the mark's instant."""
        point = self.points[name]
        (old,) = point.sightings
        here = compose(np.array(old.base), np.array((*old.place[:2], old.yaw)))
        x, y, yaw = between(np.array(base), here).tolist()
        turn = _into_base(base) @ _into_base(old.base).T
        spread = turn @ np.array(old.spread).reshape(3, 3) @ turn.T
        new = replace(old, base=base, place=(x, y, old.place[2]), yaw=yaw, spread=tuple(spread.ravel().tolist()))
        self.points[name] = replace(point, sightings=(new,))

    def stamps(self) -> tuple[int, ...]:
        """Return the stamps at which poses are needed."""
        return tuple(sorted({one.stamp for point in self.points.values() for one in point.sightings}))

    def refresh(self, name: str, bases: Bases) -> None:
        """Update the published state of a point from the current map; about 0.3 ms."""
        tracked = self.points.get(name)
        if tracked is None or not self.is_known(tracked):
            self.shown.pop(name, None)
        else:
            self.shown[name] = self._point(tracked, bases)

    def pictured(self) -> list[tuple[PointOfInterest, bytes]]:
        """Return the published points with their images."""
        return [(point, self.points[name].picture) for name, point in self.shown.items() if name in self.points]

    def load(self, points: Iterable[tuple[PointOfInterest, bytes]]) -> None:
        """Load the points of a saved map with their images."""
        for point, picture in points:
            spread = tuple(float(v) for v in point.covariance)
            place = (point.x, point.y, point.z)
            # 2: number of sightings that a point of a saved map stands for; a single contrary sighting changes nothing
            one = PointSighting(0, (0.0, 0.0, 0.0), place, point.yaw, spread, worth=2)
            self.points[point.name] = Tracked(
                point.name, point.kind, point.tag, point.size, (one,), max(point.sightings, self.config.sightings),
                point.first, point.last, picture, 40.0 if picture else 0.0,
            )  # fmt: skip

    def _point(self, tracked: Tracked, bases: Bases) -> PointOfInterest:
        mean, z, covariance = fused(tracked.sightings, bases, self.config)
        flat = covariance.ravel()
        flat.flags.writeable = False
        return PointOfInterest(
            name=tracked.name,
            kind=tracked.kind,
            tag=tracked.tag,
            x=float(mean[0]),
            y=float(mean[1]),
            z=z,
            yaw=float(mean[2]),
            covariance=flat,
            sightings=tracked.count,
            size=tracked.size,
            first=tracked.first,
            last=tracked.last,
            picture=bool(tracked.picture),
        )


def sighting(
    reading: TagReading, mount: Mount, stamp: int, base: Pose2, covariance: Array, rate: float
) -> PointSighting:
    """Return a reading as a sighting in the robot's base, with its uncertainty.

    Two poses fit a square: the one with the level normal is used, because tags usually hang upright. If both normals
    are level and fit equally well, the heading is uncertain.
    """
    turned = camera_axes(mount.yaw, mount.pitch, mount.roll)
    place = turned @ np.array(reading.middle) + np.array((mount.x, mount.y, mount.z))
    normals = [turned @ np.array(normal) for normal in (reading.normal, reading.other_normal)]
    level = [abs(float(normal[2])) for normal in normals]
    doubted = 0.6  # maximum ratio of the second pose's fit to the best one's for an unambiguous tag
    second = reading.doubt > doubted and level[1] < level[0] - 0.1
    normal = normals[1 if second else 0]
    sure = reading.doubt <= doubted or abs(level[0] - level[1]) > 0.1
    away = math.hypot(*reading.middle)
    along = 0.4 / max(reading.pixels, 1.0) * away  # standard deviation of a tag's side in an image, pixels
    side_error = 0.006  # standard deviation across the line of sight, m
    # 0.004: standard deviation of the direction of the line of sight, rad: mount and lens
    # 0.015: error of the image's stamp, s
    across = side_error + away * (0.004 + abs(rate) * 0.015)
    bearing = math.atan2(place[1] - mount.y, place[0] - mount.x)
    c, s = math.cos(bearing), math.sin(bearing)
    spin = np.array(((c, -s), (s, c)))
    spread = np.zeros((3, 3))
    spread[:2, :2] = spin @ np.diag((along**2 + side_error**2, across**2)) @ spin.T
    # 0.06: standard deviation of the normal of an unambiguous tag, rad
    # 2.0: standard deviation of the normal of an ambiguous tag, rad
    spread[2, 2] = (0.06 if sure else 2.0) ** 2
    into = _into_base(base)
    by_turn = np.eye(3)
    by_turn[0, 2], by_turn[1, 2] = -place[1], place[0]
    spread += by_turn @ into @ covariance @ into.T @ by_turn.T
    yaw = math.atan2(normal[1], normal[0])
    x, y, z = (float(v) for v in place)
    return PointSighting(stamp, base, (x, y, z), yaw, tuple(spread.ravel().tolist()))


def fused(sightings: Sequence[PointSighting], bases: Bases, config: PointsConfig) -> tuple[Array, float, Array]:
    """Return pose (x, y, yaw) and height of the sightings that agree, and the pose's covariance, (3, 3).

    The sightings from one place share its errors: the minimum covariance is that of the best sighting divided by the
    root of the number of agreeing places.
    """
    places, spreads = in_map(sightings, bases)
    inside = _agreeing(places, spreads, _worth(sightings), config)
    weights = np.array([np.linalg.inv(spread[:2, :2]) for spread in spreads[inside]])
    total = np.linalg.inv(weights.sum(axis=0))
    mean = total @ np.einsum("nij,nj->i", weights, places[inside, :2])
    sure = 1.0 / spreads[inside, 2, 2]
    yaw = math.atan2(float(np.sum(sure * np.sin(places[inside, 2]))), float(np.sum(sure * np.cos(places[inside, 2]))))
    covariance = np.zeros((3, 3))
    covariance[:2, :2] = total
    covariance[2, 2] = 1.0 / float(sure.sum())
    heights = np.array([one.place[2] for one in sightings])[inside]
    return np.array((*mean, yaw)), float(np.median(heights)), covariance


def in_map(sightings: Sequence[PointSighting], bases: Bases) -> tuple[Array, Array]:
    """Return poses (n, 3) and covariances (n, 3, 3) of sightings in map, from the robot's poses."""
    base = np.array([bases.get(one.stamp, one.base) for one in sightings])
    local = np.array([(*one.place[:2], one.yaw) for one in sightings])
    spreads = np.array([one.spread for one in sightings]).reshape(-1, 3, 3)
    c, s, zero, one = np.cos(base[:, 2]), np.sin(base[:, 2]), np.zeros(len(base)), np.ones(len(base))
    turned = np.stack((c, -s, zero, s, c, zero, zero, zero, one), axis=-1).reshape(-1, 3, 3)
    return compose(base, local), turned @ spreads @ turned.transpose(0, 2, 1)


def _worth(sightings: Sequence[PointSighting]) -> NDArray[np.int64]:
    return np.array([one.worth for one in sightings])


def _agreeing(places: Array, spreads: Array, worth: NDArray[np.int64], config: PointsConfig) -> NDArray[np.intp]:
    """Return the indices of the largest group that agrees with one of its members; of equal groups, the latest."""
    apart = places[:, None, :2] - places[None, :, :2]
    both = spreads[:, None, :2, :2] + spreads[None, :, :2, :2]
    far = np.einsum("ijk,ijkl,ijl->ij", apart, np.linalg.inv(both), apart)
    # 3.5: minimum difference of two sightings that disagree, in standard deviations
    near = (np.hypot(apart[..., 0], apart[..., 1]) < config.agree) | (far < 3.5**2)
    votes = near @ worth
    best = len(votes) - 1 - int(np.argmax(votes[::-1]))
    return np.flatnonzero(near[best])


def _consensus(sightings: Sequence[PointSighting], bases: Bases, config: PointsConfig) -> int:
    worth = _worth(sightings)
    return int(worth[_agreeing(*in_map(sightings, bases), worth, config)].sum())


def _added(sightings: tuple[PointSighting, ...], new: PointSighting) -> tuple[PointSighting, ...]:
    """Return the sightings with the new one: the better one per place; if too many, without the second oldest."""
    for i, old in enumerate(sightings):
        if old.worth > 1:  # from a saved map, with the robot's pose unknown
            continue
        moved = math.dist(old.base[:2], new.base[:2])
        # 0.08: distance within which sightings merge, m: they share their errors 0.08: difference in heading within
        # which sightings merge, rad
        if moved < 0.08 and abs(math.remainder(old.base[2] - new.base[2], math.tau)) < 0.08:
            better = new if new.spread[0] + new.spread[4] < old.spread[0] + old.spread[4] else old
            return (*sightings[:i], better, *sightings[i + 1 :])
    kept = (*sightings, new)
    return kept if len(kept) <= KEPT_SIGHTINGS else (kept[0], *kept[2:])


def _into_base(base: Pose2) -> Array:
    """Return the rotation of (x, y, yaw) from map into base's axes, (3, 3)."""
    c, s = math.cos(base[2]), math.sin(base[2])
    return np.array(((c, s, 0.0), (-s, c, 0.0), (0.0, 0.0, 1.0)))


def nearest(trail: Sequence[tuple[int, Pose2]], place: Pose2) -> tuple[int, Pose2]:
    """Return the instant when the robot was nearest to a place, and its pose at that instant."""
    return min(trail, key=lambda row: math.dist(row[1][:2], place[:2]))
