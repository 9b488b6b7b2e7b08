"""Basic motion control: moves (radius, length, angle) driven under trapezoidal or cubic motion profiles."""

import math
from dataclasses import dataclass
from typing import Final, Protocol

import numpy as np
from numpy.typing import NDArray

from monstertruck_kinematics.elementary import Array, KinematicsError, require_finite, require_positive


@dataclass(frozen=True)
class CubicRamp:
    """Speed change V(t) = v0 + a0 t + a1 t^2 + a2 t^3 that ends at v1 without acceleration.

    Args:
        v0: speed at the start.
        v1: speed at the end.
        duration: T, s.
        a0: acceleration at the start.

    Raises:
        KinematicsError: a figure that is not finite, or a duration not above 0.
    """

    v0: float
    v1: float
    duration: float
    a0: float = 0.0

    def __post_init__(self) -> None:
        for name in ("v0", "v1", "a0"):
            require_finite(name, getattr(self, name))
        require_positive("duration", self.duration)

    @property
    def coefficients(self) -> tuple[float, float]:
        """a1 = (3 (v1 - v0) - 2 a0 T)/T^2 and a2 = (a0 T - 2 (v1 - v0))/T^3."""
        change, time = self.v1 - self.v0, self.duration
        return (3.0 * change - 2.0 * self.a0 * time) / time**2, (self.a0 * time - 2.0 * change) / time**3

    @property
    def distance(self) -> float:
        """Distance covered: (v0 + v1) T/2 + a0 T^2/12."""
        return self.duration * ((self.v0 + self.v1) / 2.0 + self.a0 * self.duration / 12.0)

    @classmethod
    def to_rest(cls, v0: float, distance: float, a0: float = 0.0) -> "CubicRamp":
        """The ramp to standstill that covers a distance; with an acceleration that cannot be had, from a0 = 0.

        Raises:
            KinematicsError: speed and distance are not of one sign.
        """
        if not v0 * distance > 0.0:
            raise KinematicsError(f"distance is {distance}: expected the sign of the speed, {v0}")
        # a0 T^2/12 + v0 T/2 - distance = 0, its first positive root
        root = v0 * v0 / 4.0 + a0 * distance / 3.0
        half = v0 / 2.0 + math.copysign(math.sqrt(max(root, 0.0)), v0)
        return cls(v0, 0.0, 2.0 * distance / half, a0) if root >= 0.0 else cls(v0, 0.0, 2.0 * distance / v0)

    def speed(self, t: float) -> float:
        """Speed at time t; before and after the ramp its end values."""
        t = min(max(t, 0.0), self.duration)
        a1, a2 = self.coefficients
        return self.v0 + t * (self.a0 + t * (a1 + t * a2))

    @property
    def peaks(self) -> tuple[float, float]:
        """Maximum acceleration and jerk within it."""
        a1, a2 = self.coefficients
        time, peak = self.duration, abs(self.a0)
        if a2 and 0.0 < -a1 / (3.0 * a2) < time:
            peak = max(peak, abs(self.a0 - a1**2 / (3.0 * a2)))
        return peak, max(abs(2.0 * a1), abs(2.0 * a1 + 6.0 * a2 * time))

    def acceleration(self, t: float) -> float:
        """Acceleration at time t; 0 outside the ramp."""
        if not 0.0 <= t <= self.duration:
            return 0.0
        a1, a2 = self.coefficients
        return self.a0 + t * (2.0 * a1 + t * 3.0 * a2)


@dataclass(frozen=True, slots=True)
class TimedRamp:
    """A speed that changes by the published cubic, from ``begin`` on."""

    begin: float
    shape: CubicRamp

    def at(self, t: float) -> float:
        """Speed at t."""
        return self.shape.speed(t - self.begin)

    def acceleration(self, t: float) -> float:
        """Acceleration at t; 0 before and after the ramp."""
        return self.shape.acceleration(t - self.begin)

    def over(self, t: float) -> bool:
        """Whether the profile has finished."""
        return t - self.begin >= self.shape.duration


_COARSE: Final = np.linspace(0.0, 1.0, 97)
_FINE: Final = np.linspace(0.0, 1.0, 65)
"""Shares of the span, of its logarithm and of one of its parts, that are tried."""


def shortest_ramp(v0: float, a0: float, v1: float, max_acceleration: float, max_jerk: float) -> CubicRamp:
    """Shortest cubic ramp from the current speed and acceleration within limits.

    With acceleration a(t) = a0 + 2 a1 t + 3 a2 t^2 its jerk is greatest at one of the ends, |2 a1| or |2 a1 + 6 a2 T|,
    and its acceleration at the start or where the jerk is 0.

    Args:
        v0: present speed.
        a0: present acceleration; one beyond the limit is taken as the limit.
        v1: speed at the end.
        max_acceleration: greatest acceleration of the whole ramp.
        max_jerk: greatest jerk of the whole ramp.

    Raises:
        KinematicsError: a limit not above 0, or figures that are not finite.
    """
    require_positive("max_acceleration", max_acceleration)
    require_positive("max_jerk", max_jerk)
    for name, value in (("v0", v0), ("a0", a0), ("v1", v1)):
        require_finite(name, value)
    limit = max(max_acceleration, abs(a0)) * (1.0 + 1e-9)
    change, jerk = v1 - v0, max_jerk * (1.0 + 1e-9)
    long = 2.0 * abs(change) / max_acceleration + 8.0 * (limit / max_jerk) + (6.0 * abs(change) / max_jerk) ** 0.5
    shortest = 1e-3  # minimum duration of a ramp, s
    times = shortest * np.exp(_COARSE * math.log(max(long, 1e-2) / shortest))
    found = _kept(times, change, a0, limit, jerk)
    first = int(np.argmax(found))
    if first == 0:
        return CubicRamp(v0, v1, float(times[0] if found[0] else times[-1]), a0)
    between = times[first - 1] + _FINE * (times[first] - times[first - 1])
    return CubicRamp(v0, v1, float(between[int(np.argmax(_kept(between, change, a0, limit, jerk)))]), a0)


def _kept(time: Array, change: float, a0: float, limit: float, jerk: float) -> NDArray[np.bool_]:
    """Whether ramps of these durations keep the limits of acceleration and jerk."""
    a1, a2 = (3.0 * change - 2.0 * a0 * time) / time**2, (a0 * time - 2.0 * change) / time**3
    ends = np.maximum(np.abs(2.0 * a1), np.abs(2.0 * a1 + 6.0 * a2 * time))
    with np.errstate(divide="ignore", invalid="ignore"):
        turning = -a1 / (3.0 * a2)
        peak = np.abs(a0 - a1**2 / (3.0 * a2))
    inside = (turning > 0.0) & (turning < time)
    return (ends <= jerk) & (~inside | (peak <= limit))


class MotionProfile(Protocol):
    """Position and speed over time, from rest to rest."""

    @property
    def duration(self) -> float:
        """Total time, s."""

    def position(self, times: Array) -> Array:
        """(N,) distance covered, m (rad for a turn on the spot); constant before the start and after the end."""

    def speed(self, times: Array) -> Array:
        """(N,) its derivative."""


@dataclass(frozen=True)
class TrapezoidalProfile:
    """Constant acceleration, constant speed, constant braking; a triangle if the distance is short.

    Args:
        distance: m (or rad), negative for backwards.
        max_speed: m/s.
        max_acceleration: m/s^2.

    Raises:
        KinematicsError: a limit not above 0, or a distance that is not finite.
    """

    distance: float
    max_speed: float
    max_acceleration: float

    def __post_init__(self) -> None:
        require_finite("distance", self.distance)
        require_positive("max_speed", self.max_speed)
        require_positive("max_acceleration", self.max_acceleration)

    @property
    def peak(self) -> float:
        """Speed reached, m/s, positive."""
        return min(self.max_speed, math.sqrt(abs(self.distance) * self.max_acceleration))

    @property
    def duration(self) -> float:
        """Total time, s."""
        return abs(self.distance) / self.peak + self.peak / self.max_acceleration if self.distance else 0.0

    def position(self, times: Array) -> Array:
        """(N,) distance covered."""
        t = np.clip(times, 0.0, self.duration)
        ramp = self.peak / self.max_acceleration
        left = self.duration - t
        up = 0.5 * self.max_acceleration * t**2
        down = abs(self.distance) - 0.5 * self.max_acceleration * left**2
        along = self.peak * (t - 0.5 * ramp)
        return np.asarray(np.sign(self.distance) * np.where(t < ramp, up, np.where(left < ramp, down, along)))

    def speed(self, times: Array) -> Array:
        """(N,) speed, with the distance's sign."""
        inside = np.minimum(times, self.duration - times)
        return np.asarray(np.sign(self.distance) * np.clip(self.max_acceleration * inside, 0.0, self.peak))


@dataclass(frozen=True)
class CubicProfile:
    """Cubic ramp up, constant speed, cubic ramp down: no jump of the acceleration.

    A distance too short for full speed is driven with both ramps to a lower peak.

    Args:
        distance: m (or rad), negative for backwards.
        max_speed: m/s.
        ramp_time: ramp time of either ramp, s; the peak acceleration is 1.5 max_speed / ramp_time.

    Raises:
        KinematicsError: a limit not above 0, or a distance that is not finite.
    """

    distance: float
    max_speed: float
    ramp_time: float

    def __post_init__(self) -> None:
        require_finite("distance", self.distance)
        require_positive("max_speed", self.max_speed)
        require_positive("ramp_time", self.ramp_time)

    @property
    def peak(self) -> float:
        """Speed reached, m/s, positive."""
        return min(self.max_speed, abs(self.distance) / self.ramp_time)

    @property
    def duration(self) -> float:
        """Total time, s."""
        return abs(self.distance) / self.peak + self.ramp_time if self.distance else 0.0

    def position(self, times: Array) -> Array:
        """(N,) distance covered."""
        t = np.clip(times, 0.0, self.duration)
        left = self.duration - t
        along = self.peak * (t - 0.5 * self.ramp_time)
        covered = np.where(
            t < self.ramp_time,
            self._ramp_distance(t),
            np.where(left < self.ramp_time, abs(self.distance) - self._ramp_distance(left), along),
        )
        return np.asarray(np.sign(self.distance) * covered)

    def speed(self, times: Array) -> Array:
        """(N,) speed, with the distance's sign."""
        share = np.clip(np.minimum(times, self.duration - times) / self.ramp_time, 0.0, 1.0)
        return np.asarray(np.sign(self.distance) * self.peak * share**2 * (3.0 - 2.0 * share))

    def _ramp_distance(self, t: Array) -> Array:
        share = t / self.ramp_time
        return np.asarray(self.peak * self.ramp_time * share**3 * (1.0 - 0.5 * share))


@dataclass(frozen=True)
class BasicMove:
    """One basic move: an arc of radius R (left positive) and length D turns by phi = D/R.

    R = 0 turns on the spot (D = 0, phi given), infinite R goes straight (phi = 0).

    Args:
        radius: R, m.
        length: D, m, negative backwards.
        angle: phi, rad.
        bearing: direction of travel in the body frame, rad; 0 = ahead, pi/2 = sideways to the left.

    Raises:
        KinematicsError: figures that contradict phi = D/R, or NaN.
    """

    radius: float
    length: float
    angle: float
    bearing: float = 0.0

    def __post_init__(self) -> None:
        require_finite("length", self.length)
        require_finite("angle", self.angle)
        require_finite("bearing", self.bearing)
        if math.isnan(self.radius):
            raise KinematicsError("radius is nan: expected metres, 0 or infinity")
        turned = 0.0 if math.isinf(self.radius) else self.angle * self.radius
        if abs(self.length - turned) > 1e-9 * (1.0 + abs(self.length)) and not math.isinf(self.radius):
            raise KinematicsError(f"length is {self.length}: expected radius x angle = {turned:.6g}")
        if math.isinf(self.radius) and self.angle != 0.0:
            raise KinematicsError(f"angle is {self.angle}: expected 0 for a straight move")

    @classmethod
    def straight(cls, length: float, bearing: float = 0.0) -> "BasicMove":
        """Straight ahead (or back), or along another direction without turning."""
        return cls(math.inf, length, 0.0, bearing)

    @classmethod
    def spot(cls, angle: float) -> "BasicMove":
        """Turn on the spot."""
        return cls(0.0, 0.0, angle)

    @classmethod
    def arc(cls, radius: float, length: float, bearing: float = 0.0) -> "BasicMove":
        """Arc of a length; the turn follows.

        Raises:
            KinematicsError: the radius is 0 (that is ``spot``).
        """
        if radius == 0.0:
            raise KinematicsError("radius is 0: expected an arc; a turn on the spot has an angle, no length")
        return cls(radius, length, length / radius, bearing)

    @property
    def profile_distance(self) -> float:
        """Extent of a motion profile: the length, m, or the angle, rad, of a turn on the spot."""
        return self.angle if self.radius == 0.0 else self.length

    @property
    def direction(self) -> tuple[float, float, float]:
        """Twist at unit rate of ``profile_distance``."""
        if self.radius == 0.0:
            return 0.0, 0.0, 1.0
        ahead, aside = (round(part, 15) for part in (math.cos(self.bearing), math.sin(self.bearing)))
        return ahead, aside, 1.0 / self.radius
