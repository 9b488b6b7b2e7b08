"""Sonar model: pure functions of the surrounding walls, for emulators and for studies without a daemon.

``beam`` is the range along the axis. ``cone`` samples the cone with rays and uses the nearest point that returns sound:
a wall if its normal is within the critical angle of the direction to the sonar, an edge or a corner in every direction.
Sound from another sonar arrives in the same way, over a longer or shorter path, shifted by the difference between the
send times: a sonar cannot identify the source of a sound (after Kuc and Siegel, "Physically Based Simulation Model for
Acoustic Sensor Robot Navigation", 1987; Borenstein and Koren, "Error Eliminating Rapid Ultrasonic Firing", 1995).
"""

from collections import deque
from collections.abc import Callable, Sequence
from math import ceil, cos, inf, pi, sin
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from monstertruck_kinematics.elementary import Array
from monstertruck_runtime.errors import InputError
from monstertruck_sim.world.config import SonarModelConfig, SonarPlace
from monstertruck_sim.world.noise import SONAR, generator
from monstertruck_sim.world.plant import Caster, Plant
from monstertruck_sim.world.sensors import turned

SPEED_OF_SOUND: Final = 343.0
"""Speed of sound in air at 20 degrees Celsius (m/s)."""


Solids = Callable[[float, float, float, float], Caster | None]
"""Returns a caster for solids that rays hit in addition to the map's walls, for a body of a yaw, pitch and roll (rad)
and height (m).
"""


class Ping(NamedTuple):
    """A sonar ping: position (m) and direction (rad) in the map frame, and time (s)."""

    x: float
    y: float
    yaw: float
    time: float = 0.0


class Surface(NamedTuple):
    """Points hit by the rays of one ping's cone; shapes (n,)."""

    ping: Ping
    x: Array
    """x of the points in the map frame (m)."""
    y: Array
    ranges: Array
    """Distances from the sonar (m); inf without a hit within ``audible``."""
    normals: Array
    """Direction of the wall's normal (rad), in either sense."""
    scatters: NDArray[np.bool_]
    """Whether a point is an edge or a corner, which reflects in all directions."""


def placed(sonar: SonarPlace, x: float, y: float, yaw: float, time: float = 0.0) -> Ping:
    """Return the ping of a sonar on a body at (x, y, yaw) in the map frame."""
    c, s = cos(yaw), sin(yaw)
    return Ping(x + c * sonar.x - s * sonar.y, y + s * sonar.x + c * sonar.y, yaw + sonar.yaw, time)


def beam(cast: Caster, ping: Ping, model: SonarModelConfig) -> float:
    """Return the range along the axis (m); inf without a hit within ``range_max``."""
    return float(cast(np.array([ping.x]), np.array([ping.y]), np.array([ping.yaw]), model.range_max)[0])


def surface(cast: Caster, ping: Ping, model: SonarModelConfig) -> Surface:
    """Return the reflecting points in the cone of one sonar."""
    count = 2 * ceil(model.field_of_view / 2 / 0.015) + 1  # angle between the rays of a cone, rad
    angles = ping.yaw + np.linspace(-model.field_of_view / 2, model.field_of_view / 2, count)
    ranges = cast(np.full(count, ping.x), np.full(count, ping.y), angles, model.audible)
    hit = np.isfinite(ranges)
    way = np.where(hit, ranges, 0.0)
    x, y = ping.x + way * np.cos(angles), ping.y + way * np.sin(angles)
    normals, scatters = _normals(x, y, ranges)
    return Surface(ping, x, y, ranges, normals, scatters)


def leaning(cast: Caster, yaw: float, pitch: float, roll: float, over: float) -> Caster:
    """Return a caster for rays that tilt with a body; it measures ranges along the tilted rays.

    The ground gives no echo, because its angle of incidence is too flat.

    Args:
        cast: ranges to the walls in the horizontal plane, for the ray angles of a level body.
        yaw: yaw of the body in the map frame (rad).
        pitch: pitch of the body, nose down positive (rad).
        roll: roll of the body, right side down positive (rad).
        over: height of the walls above the sonars (m); sound passes over the walls above this height.
    """
    if pitch == 0.0 and roll == 0.0:
        return cast

    def along(xs: Array, ys: Array, angles: Array, reach: float, times_ns: NDArray[np.int64] | None = None, /) -> Array:
        flat = np.cos(angles - yaw), np.sin(angles - yaw), np.zeros(len(angles))
        ahead, aside, up = turned(flat, np.array(pitch), np.array(roll))
        level = np.hypot(ahead, aside)
        ranges = cast(xs, ys, yaw + np.arctan2(aside, ahead), reach, times_ns) / level
        return np.where((ranges <= reach) & (ranges * up <= over), ranges, inf)

    return along


def nearer(one: Caster, other: Caster | None) -> Caster:
    """Combine two casters: each ray returns the nearer hit."""
    if other is None:
        return one

    def along(xs: Array, ys: Array, angles: Array, reach: float, times_ns: NDArray[np.int64] | None = None, /) -> Array:
        ranges = one(xs, ys, angles, reach, times_ns), other(xs, ys, angles, reach, times_ns)
        return np.asarray(np.minimum(*ranges))

    return along


def cone(surfaces: Sequence[Surface], listener: Ping, model: SonarModelConfig) -> float:
    """Return the nearest echo that ``listener`` takes for its own (m); inf if none is within ``range_max``.

    Args:
        surfaces: surfaces for every sonar that has sent a ping whose sound has not yet decayed, including ``listener``.
        listener: position, axis and send time of the listening sonar.
        model: settings.
    """
    return min((_arrival(found, listener, model) for found in surfaces), default=inf)


def heard(distance: float, model: SonarModelConfig, noise: np.random.Generator | None) -> float:
    """Return the measured range (m) with noise, dropouts and limits; inf without an echo.

    Args:
        distance: true distance (m); inf without an echo.
        model: settings.
        noise: random generator, used for two draws; None for no noise.
    """
    if noise is not None:
        drawn, kept = noise.standard_normal(), noise.random() >= model.dropout
        if not kept:
            return inf
        if distance < inf:
            distance += float(drawn) * float(np.hypot(model.noise, model.noise_share * distance))
    return max(distance, model.range_min) if distance <= model.range_max else inf


def _normals(x: Array, y: Array, ranges: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Return the wall normal's direction at every point, from the principal axes of its neighbours, and the edges."""
    count = len(ranges)
    near, far = np.minimum(ranges[1:], ranges[:-1]), np.maximum(ranges[1:], ranges[:-1])
    with np.errstate(invalid="ignore", divide="ignore"):
        # 0.2: neighbouring rays have an edge between them if their ranges differ by more, m, and their inverse ranges
        # by more than this share of the greater: along a straight wall inverse ranges are similar even at a grazing
        # angle
        gaps = (far - near > 0.12) & (1.0 - near / far > 0.2)  # m
    piece = np.concatenate([[0], np.cumsum(gaps)])
    scatters = np.zeros(count, dtype=np.bool_)
    # The nearer side of a jump within the cone is an edge.
    nearer = np.flatnonzero(gaps) + (ranges[1:] < ranges[:-1])[gaps]
    scatters[nearer] = np.isfinite(ranges[nearer])
    # 0.08: distance of the points on both sides that give the direction of a wall, m: some cells of a map
    around = np.hypot(x[:, None] - x, y[:, None] - y) <= 0.08
    # 3: rays on both sides that tell the direction of a wall at any distance
    around |= np.abs(np.arange(count)[:, None] - np.arange(count)) <= 3
    around &= piece[:, None] == piece
    weights = around / around.sum(axis=1, keepdims=True)
    dx, dy = x - (weights @ x)[:, None], y - (weights @ y)[:, None]
    xx, yy, xy = (weights * dx**2).sum(1), (weights * dy**2).sum(1), (weights * dx * dy).sum(1)
    along = np.arctan2(2 * xy, xx - yy) / 2
    middle, half = (xx + yy) / 2, np.hypot((xx - yy) / 2, xy)
    with np.errstate(invalid="ignore"):
        # 0.25: ratio of the spread across to the spread along; points above it are a corner instead of a wall
        scatters |= np.sqrt(np.maximum(middle - half, 0.0)) > 0.25 * np.sqrt(middle + half)
    return along + pi / 2, scatters


def _arrival(found: Surface, listener: Ping, model: SonarModelConfig) -> float:
    """Return the range that ``listener`` reports for the sound of one ping; inf if no sound reaches it."""
    sent = found.ping
    own = sent == listener
    if not own and not model.cross_talk:
        return inf
    dx, dy = listener.x - found.x, listener.y - found.y
    back = np.hypot(dx, dy)
    lead = (sent.time - listener.time) * SPEED_OF_SOUND / 2
    apparent = (found.ranges + back) / 2 + lead
    returning, sending = np.arctan2(dy, dx), np.arctan2(sent.y - found.y, sent.x - found.x)
    bisector = sending + _turn(returning - sending) / 2
    off_normal = np.abs(_turn(2 * (bisector - found.normals))) / 2
    off_axis = np.abs(_turn(returning + pi - listener.yaw))
    audible = np.isfinite(found.ranges) & (apparent > 0.0) & (off_axis <= model.field_of_view / 2 + 1e-9)
    audible &= found.scatters | (off_normal <= model.critical_angle)
    nearest = float(apparent[audible].min(initial=inf))
    return nearest if nearest <= model.range_max else inf


def _turn(angles: Array) -> Array:
    """Wrap angles to [-pi, pi)."""
    turned: Array = (angles + pi) % (2 * pi) - pi
    return turned


class SimulatedSonars:
    """``SonarSource``: every ping starts at the body's current pose, and all other sonars detect it until it decays.

    Args:
        plant: the robot that carries the sonars, which tilt with it.
        cast: casts rays to the walls.
        config: true parameters.
        seed: noise seed, or None for no noise.
        wall_height: height of the walls above the ground (m).
        solids: objects that sonars detect in addition to the walls, or None.
    """

    def __init__(
        self,
        plant: Plant,
        cast: Caster,
        config: SonarModelConfig,
        seed: int | None,
        wall_height: float = inf,
        solids: Solids | None = None,
    ) -> None:
        self._plant, self._cast, self._config, self._seed, self._solids = plant, cast, config, seed, solids
        self._over = wall_height - config.height
        # 32: number of recent pings kept: more than are sent before the sound of one decays
        self._pings: deque[tuple[str, Ping, Caster, Surface | None]] = deque(maxlen=32)
        self._heard = 0

    def fire(self, name: str, time_ns: int) -> None:
        """Send a ping.

        Raises:
            InputError: the robot has no sonar with that name.
        """
        place = self._config.sonars.get(name)
        if place is None:
            raise InputError(f"no sonar {name} in sim.world.sonar.sonars; known: {', '.join(self._config.sonars)}")
        self._plant.advance(time_ns)
        x, y, yaw, pitch, roll, z = self._plant.poses(np.array([time_ns]))[:, 0].tolist()
        ping = placed(place, x, y, yaw, time_ns * 1e-9)
        solids = None if self._solids is None else self._solids(yaw, pitch, roll, z)
        cast = nearer(leaning(self._cast, yaw, pitch, roll, self._over), solids)
        found = surface(cast, ping, self._config) if self._config.model == "cone" else None
        self._pings.append((name, ping, cast, found))

    def range(self, name: str) -> float:
        """Return the distance measured by a sonar's latest ping (m) once the echo has returned; inf without an echo."""
        newest = next(((ping, cast) for fired, ping, cast, _ in reversed(self._pings) if fired == name), None)
        if newest is None:
            return inf
        mine, cast = newest
        if self._config.model == "beam":
            distance = beam(cast, mine, self._config)
        else:
            alive = 2 * self._config.audible / SPEED_OF_SOUND
            found = [seen for _, ping, _, seen in self._pings if seen and abs(ping.time - mine.time) < alive]
            distance = cone(found, mine, self._config)
        self._heard += 1
        return heard(distance, self._config, None if self._seed is None else generator(self._seed, SONAR, self._heard))
