"""Lines fitted to echoes: every echo is an arc in odom, and a wall is the line that touches the arcs.

A sonar at p hears a wall whose normal is in its cone over the perpendicular, at r = d(p). A wall whose normal is beyond
the cone's edge by the angle b is heard along the edge, at r = d(p)/cos b, as long as the sound comes back from there.
A narrow beam is a cone without an opening.
"""

import math
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from monstertruck_kinematics.elementary import Array

NOISE: Final = 0.005
"""Standard deviation of a range, m, to which ``NOISE_SHARE`` of the range is added in quadrature."""
NOISE_SHARE: Final = 0.01
UNHEARD: Final = 0.5
"""What an echo from where none is expected counts like, m."""
ROBUST: Final = 2.0
"""Residual, in standard deviations, from which on an echo counts for less (Cauchy's weights)."""
TIGHT: Final = 3.0
"""Residual, in standard deviations, up to which a line explains an echo."""
SPARE: Final = 0.05
"""By which the critical angle of a wall may be greater than stated, rad."""
INERTIA: Final = (0.05, 0.03)
"""Standard deviations of the estimate before: rad, m."""
GUESSES: Final = 24
"""Directions from which a line is fitted without an estimate before."""
STEPS: Final = 4, 10
"""Of Gauss and Newton, from an estimate and from a guess."""


class WallEstimate(NamedTuple):
    """A wall in odom: n . p = c for its points p, with n = (cos normal, sin normal) pointing from the robot to it."""

    normal: float
    """Direction, rad."""
    offset: float
    """c, m."""

    def distance(self, x: float, y: float) -> float:
        """From a point to the wall, m; negative beyond it."""
        return self.offset - math.cos(self.normal) * x - math.sin(self.normal) * y

    @property
    def heading(self) -> float:
        """Direction of travel with the wall on the left, rad."""
        return math.remainder(self.normal - math.pi / 2, math.tau)


@dataclass(frozen=True, slots=True)
class Cone:
    """How sonars hear.

    Attributes:
        half: half of the opening angle, rad; 0 = a beam.
        critical: greatest angle from the wall's normal at which sound comes back, rad.
    """

    half: float
    critical: float

    def ranges(self, echoes: Array, normal: Array, distance: Array) -> tuple[Array, Array, NDArray[np.bool_]]:
        """What sonars measure of walls.

        Args:
            echoes: see ``ECHO``; (..., n) of columns.
            normal: of the walls, rad.
            distance: from the sonars to the walls, m.

        Returns:
            Ranges, m; their derivative by the wall's direction at a fixed distance, m/rad; whether sound comes back.
        """
        off = np.remainder(normal - echoes[..., 2] + math.pi, math.tau) - math.pi
        beyond = np.maximum(np.abs(off) - self.half, 0.0)
        heard = beyond <= self.critical + SPARE
        beyond = np.where(heard, beyond, 0.0)
        share = 1.0 / np.cos(beyond)
        slope = np.where(heard & (np.abs(off) > self.half), np.sign(off) * np.tan(beyond), 0.0)
        return distance * share, distance * share * slope, heard

    def hears(self, axis: float, normal: float) -> bool:
        """Whether a sonar hears a wall of that direction."""
        return abs(math.remainder(normal - axis, math.tau)) - self.half <= self.critical


ECHO: Final = ("x", "y", "axis", "range", "sonar", "way", "time")
"""Columns of the echoes: place (m) and axis (rad) of the sonar in odom, range (m), its number; way driven (m) and time
(s) when it came."""


class EstimateFit(NamedTuple):
    """A line and how well it fits."""

    line: WallEstimate
    explained: int
    """Echoes within ``TIGHT``."""
    sigma: tuple[float, float]
    """Standard deviations of its direction, rad, and of its distance from the robot, m."""


def deviation(ranges: Array) -> Array:
    """Standard deviation of ranges, m."""
    return np.asarray(np.hypot(NOISE, NOISE_SHARE * ranges))


def residuals(echoes: Array, line: WallEstimate, cone: Cone) -> Array:
    """(n,) measured less expected range of every echo, in standard deviations; inf where none is expected."""
    distance = line.offset - math.cos(line.normal) * echoes[:, 0] - math.sin(line.normal) * echoes[:, 1]
    expected, _, heard = cone.ranges(echoes, np.array(line.normal), distance)
    return np.where(heard, (echoes[:, 3] - expected) / deviation(echoes[:, 3]), np.inf)


def refine(echoes: Array, before: WallEstimate, at: tuple[float, float], cone: Cone) -> EstimateFit:
    """Fit a line to echoes, from an estimate that it stays near to where echoes say little.

    Args:
        echoes: (n, 7), see ``ECHO``.
        before: estimate.
        at: point whose distance to the line is estimated, m: the robot.
        cone: how the sonars hear.
    """
    normals, distances, cost, information = _fitted(
        echoes, np.array([before.normal]), np.array([before.distance(*at)]), at, cone, INERTIA, STEPS[0]
    )
    return _best(echoes, normals, distances, cost, information, at, cone)


def search(echoes: Array, at: tuple[float, float], cone: Cone) -> EstimateFit:
    """Fit a line to at least three echoes without an estimate: the best of several directions; see ``refine``."""
    normals = np.linspace(-math.pi, math.pi, GUESSES, endpoint=False)
    offsets = echoes[:, :2] - at
    along = offsets[:, 0] * np.cos(normals)[:, None] + offsets[:, 1] * np.sin(normals)[:, None]
    share, _, _ = cone.ranges(echoes, normals[:, None], np.ones_like(along))
    distances = np.median(echoes[:, 3] / share + along, axis=1)
    return _best(echoes, *_fitted(echoes, normals, distances, at, cone, (math.inf, math.inf), STEPS[1]), at, cone)


def _fitted(
    echoes: Array,
    normals: Array,
    distances: Array,
    at: tuple[float, float],
    cone: Cone,
    inertia: tuple[float, float],
    steps: int,
) -> tuple[Array, Array, Array, Array]:
    """Directions, distances, costs (k,), and information (k, 3) of k fits after some steps."""
    x, y = echoes[:, 0] - at[0], echoes[:, 1] - at[1]
    weight = 1.0 / deviation(echoes[:, 3]) ** 2
    first_normals, first_distances = normals, distances
    held = 1.0 / np.array(inertia) ** 2
    for _ in range(steps):
        c, s = np.cos(normals)[:, None], np.sin(normals)[:, None]
        far = distances[:, None] - c * x - s * y
        expected, by_angle, heard = cone.ranges(echoes, normals[:, None], far)
        share = expected / np.where(np.abs(far) < 1e-9, 1e-9, far)
        missing = np.where(heard, echoes[:, 3] - expected, UNHEARD)
        kept = heard * weight / (1.0 + missing**2 * weight / ROBUST**2)
        da, dd = (s * x - c * y) * share + by_angle, share
        aa, ad, dd2 = (kept * da * da).sum(1) + held[0], (kept * da * dd).sum(1), (kept * dd * dd).sum(1) + held[1]
        ga = (kept * da * missing).sum(1) + held[0] * (first_normals - normals)
        gd = (kept * dd * missing).sum(1) + held[1] * (first_distances - distances)
        determinant = np.maximum(aa * dd2 - ad * ad, 1e-12 * (1.0 + aa * dd2))
        normals = normals + np.clip((dd2 * ga - ad * gd) / determinant, -0.3, 0.3)
        distances = distances + np.clip((aa * gd - ad * ga) / determinant, -0.3, 0.3)
    return normals, distances, np.log1p(missing**2 * weight / ROBUST**2).sum(1), np.stack([aa, ad, dd2], axis=1)


def _best(
    echoes: Array,
    normals: Array,
    distances: Array,
    cost: Array,
    information: Array,
    at: tuple[float, float],
    cone: Cone,
) -> EstimateFit:
    best = int(np.argmin(np.where(distances > 0.0, cost, np.inf)))
    normal, distance = float(normals[best]), float(distances[best])
    line = WallEstimate(
        math.remainder(normal, math.tau), distance + math.cos(normal) * at[0] + math.sin(normal) * at[1]
    )
    explained = int((np.abs(residuals(echoes, line, cone)) < TIGHT).sum())
    aa, ad, dd = information[best]
    determinant = max(float(aa * dd - ad * ad), 1e-12)
    return EstimateFit(line, explained, (math.sqrt(float(dd) / determinant), math.sqrt(float(aa) / determinant)))
