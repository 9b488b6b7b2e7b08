"""From readings to points of interest: pure; a point is stored relative to a pose, so it moves with the map.

Every sighting keeps its place in the robot's base and the instant of its picture. Where the robot was then is asked of
the mapper again after every correction, so sightings from before and after a loop agree once it is closed.
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
"""Sightings of a point at most."""


@dataclass(frozen=True, slots=True)
class PointSighting:
    """A point as seen from the robot at one instant."""

    stamp: int
    """Of the picture, ns."""
    base: Pose2
    """The robot in map then, as known at that time."""
    place: Triple
    """In base, m."""
    yaw: float
    """Direction it faces, in base, rad."""
    spread: tuple[float, ...]
    """Row-major (3, 3), covariance of x, y, yaw in base."""
    worth: int = 1
    """Sightings that it stands for."""


@dataclass(frozen=True, slots=True)
class Tracked:
    """One point, published or not yet."""

    name: str
    kind: PointKind
    tag: int | None
    size: float | None
    sightings: tuple[PointSighting, ...]
    count: int
    """All pictures so far."""
    first: int
    last: int
    picture: bytes = b""
    sharpest: float = 0.0
    """Side of the tag in it, pixels."""


Bases = Mapping[int, Pose2]
"""Where the robot was at instants, by the map as it is now."""
PoseAsker = Callable[[tuple[int, ...]], Bases]
"""Asks the mapper where the robot was at instants; answers with what it knows by now."""


@dataclass
class PointMap:
    """All points.

    Args:
        config: gates.
        mount: of the camera.
    """

    config: PointsConfig
    mount: Mount
    points: dict[str, Tracked] = field(default_factory=dict)
    shown: dict[str, PointOfInterest] = field(default_factory=dict)
    """As they were when ``refresh`` was last called for each."""

    def see(self, reading: TagReading, stamp: int, base: Pose2, covariance: Array, rate: float) -> bool:
        """Take a reading in; returns whether it made a tag a point of interest.

        Args:
            reading: of a picture.
            stamp: of it, ns.
            base: the robot then, in map.
            covariance: of that, (3, 3).
            rate: at which the robot turned, rad/s.
        """
        name = f"tag-{reading.tag}"
        known = self.points.get(name)
        if known is None and len(self.points) >= self.config.most:
            return False
        # What a saved map says was on the clock of another start.
        # 100_000_000: least time between two pictures that count, ns
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
        """Whether enough pictures agree on it."""
        if point.kind is PointKind.MARK:
            return True
        needed = self.config.sightings
        return point.count >= needed and (len(point.sightings) == 1 or _consensus(point.sightings, {}, self.config) > 1)

    def mark(self, name: str, stamp: int, base: Pose2, place: Pose2, covariance: Array) -> None:
        """Mark a place by name, as an operator does.

        Args:
            name: of the place; one that is there is moved.
            stamp: an instant at which the robot was near it, ns.
            base: where it was then, in map.
            place: to be marked, in map.
            covariance: of the robot's pose, (3, 3).
        """
        x, y, yaw = between(np.array(base), np.array(place)).tolist()
        into = _into_base(base)
        # 0.01: standard deviation of a place marked by an operator, m and rad
        spread = tuple(float(v) for v in (into @ covariance @ into.T + np.eye(3) * 0.01**2).ravel())
        one = PointSighting(stamp, base, (x, y, 0.0), yaw, spread)
        self.points[name] = Tracked(name, PointKind.MARK, None, None, (one,), 0, stamp, stamp)

    def anchor(self, name: str, base: Pose2) -> None:
        """Leave a mark where it is in the map, for the robot was at ``base`` at its instant by the map of today."""
        point = self.points[name]
        (old,) = point.sightings
        here = compose(np.array(old.base), np.array((*old.place[:2], old.yaw)))
        x, y, yaw = between(np.array(base), here).tolist()
        turn = _into_base(base) @ _into_base(old.base).T
        spread = turn @ np.array(old.spread).reshape(3, 3) @ turn.T
        new = replace(old, base=base, place=(x, y, old.place[2]), yaw=yaw, spread=tuple(spread.ravel().tolist()))
        self.points[name] = replace(point, sightings=(new,))

    def stamps(self) -> tuple[int, ...]:
        """Instants at which it matters where the robot was."""
        return tuple(sorted({one.stamp for point in self.points.values() for one in point.sightings}))

    def refresh(self, name: str, bases: Bases) -> None:
        """Bring what is shown of a point up to date, by the map as it is now; about 0.3 ms."""
        tracked = self.points.get(name)
        if tracked is None or not self.is_known(tracked):
            self.shown.pop(name, None)
        else:
            self.shown[name] = self._point(tracked, bases)

    def pictured(self) -> list[tuple[PointOfInterest, bytes]]:
        """Points as shown, with their pictures."""
        return [(point, self.points[name].picture) for name, point in self.shown.items() if name in self.points]

    def load(self, points: Iterable[tuple[PointOfInterest, bytes]]) -> None:
        """Take over points of a saved map, with their pictures."""
        for point, picture in points:
            spread = tuple(float(v) for v in point.covariance)
            place = (point.x, point.y, point.z)
            # 2: sightings that a point of a saved map is worth: one that disagrees changes nothing yet
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
    """A reading in the robot's base, with what may be wrong with it.

    Of the two poses of a square the one is taken whose normal is level, as of a tag that hangs upright; where both are,
    and fit alike, its heading is uncertain.
    """
    turned = camera_axes(mount.yaw, mount.pitch, mount.roll)
    place = turned @ np.array(reading.middle) + np.array((mount.x, mount.y, mount.z))
    normals = [turned @ np.array(normal) for normal in (reading.normal, reading.other_normal)]
    level = [abs(float(normal[2])) for normal in normals]
    doubted = 0.6  # ratio of the fits of the best and the second pose of a square up to which the tag is unambiguous
    second = reading.doubt > doubted and level[1] < level[0] - 0.1
    normal = normals[1 if second else 0]
    sure = reading.doubt <= doubted or abs(level[0] - level[1]) > 0.1
    away = math.hypot(*reading.middle)
    along = 0.4 / max(reading.pixels, 1.0) * away  # standard deviation of a tag's side in a picture, pixels
    side_error = 0.006  # standard deviation across the line of sight, m
    # 0.004: standard deviation of the direction of the line of sight, rad: mount and lens
    # 0.015: error of the picture's stamp, s
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
    """Pose (x, y, yaw) of those that agree, height, and the pose's covariance, (3, 3).

    Errors of one place are alike in its sightings: the covariance is not less than that of the best one over the root
    of how many places agree.
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
    """Poses (n, 3) and covariances (n, 3, 3) of sightings, by where the robot was."""
    base = np.array([bases.get(one.stamp, one.base) for one in sightings])
    local = np.array([(*one.place[:2], one.yaw) for one in sightings])
    spreads = np.array([one.spread for one in sightings]).reshape(-1, 3, 3)
    c, s, zero, one = np.cos(base[:, 2]), np.sin(base[:, 2]), np.zeros(len(base)), np.ones(len(base))
    turned = np.stack((c, -s, zero, s, c, zero, zero, zero, one), axis=-1).reshape(-1, 3, 3)
    return compose(base, local), turned @ spreads @ turned.transpose(0, 2, 1)


def _worth(sightings: Sequence[PointSighting]) -> NDArray[np.int64]:
    return np.array([one.worth for one in sightings])


def _agreeing(places: Array, spreads: Array, worth: NDArray[np.int64], config: PointsConfig) -> NDArray[np.intp]:
    """Indices of the largest group that agrees with one of them, of equal ones the newest."""
    apart = places[:, None, :2] - places[None, :, :2]
    both = spreads[:, None, :2, :2] + spreads[None, :, :2, :2]
    far = np.einsum("ijk,ijkl,ijl->ij", apart, np.linalg.inv(both), apart)
    # 3.5: standard deviations at which two sightings disagree
    near = (np.hypot(apart[..., 0], apart[..., 1]) < config.agree) | (far < 3.5**2)
    votes = near @ worth
    best = len(votes) - 1 - int(np.argmax(votes[::-1]))
    return np.flatnonzero(near[best])


def _consensus(sightings: Sequence[PointSighting], bases: Bases, config: PointsConfig) -> int:
    worth = _worth(sightings)
    return int(worth[_agreeing(*in_map(sightings, bases), worth, config)].sum())


def _added(sightings: tuple[PointSighting, ...], new: PointSighting) -> tuple[PointSighting, ...]:
    """With the new one; of one place the better one stays, and of too many the oldest but the first goes."""
    for i, old in enumerate(sightings):
        if old.worth > 1:  # of a saved map: from where it was seen is not known
            continue
        moved = math.dist(old.base[:2], new.base[:2])
        # 0.08: distance within which sightings count as one, m: their errors are the same
        # 0.08: difference in heading within which sightings count as one, rad
        if moved < 0.08 and abs(math.remainder(old.base[2] - new.base[2], math.tau)) < 0.08:
            better = new if new.spread[0] + new.spread[4] < old.spread[0] + old.spread[4] else old
            return (*sightings[:i], better, *sightings[i + 1 :])
    kept = (*sightings, new)
    return kept if len(kept) <= KEPT_SIGHTINGS else (kept[0], *kept[2:])


def _into_base(base: Pose2) -> Array:
    """Turns (x, y, yaw) of map into base's axes, (3, 3)."""
    c, s = math.cos(base[2]), math.sin(base[2])
    return np.array(((c, s, 0.0), (-s, c, 0.0), (0.0, 0.0, 1.0)))


def nearest(trail: Sequence[tuple[int, Pose2]], place: Pose2) -> tuple[int, Pose2]:
    """The instant at which the robot was nearest to a place, and where it was."""
    return min(trail, key=lambda row: math.dist(row[1][:2], place[:2]))
