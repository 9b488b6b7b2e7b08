"""Lines fitted to echoes: every echo is an arc in odom, and a wall is the line that touches the arcs.

A sonar at p hears a wall with its normal inside the cone along the perpendicular, at r = d(p). If the normal lies
outside the cone's edge by the angle b, the sonar hears the wall along the edge, at r = d(p)/cos b, as long as sound
returns from there. A narrow beam is a cone with zero opening angle.
"""

import math
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from monstertruck_kinematics.elementary import Array

TIGHT: Final = 3.0
"""Maximum residual of an echo explained by a line, in standard deviations."""
GUESSES: Final = 24, 5
"""Number of start directions of a line fit without a previous estimate, and of the best ones fitted to the end."""
NEWTON_STEPS: Final = 4, 4, 6
"""Gauss-Newton steps: from an estimate, from all guesses, and further from the best ones."""
FREE: Final = (math.inf, math.inf)
"""Inertia without a previous estimate."""


class WallEstimate(NamedTuple):
    """A wall in odom: n . p = c for its points p, with n = (cos normal, sin normal) pointing from the robot to it."""

    normal: float
    """Direction of the normal (rad)."""
    offset: float
    """Offset c (m)."""

    def distance(self, x: float, y: float) -> float:
        """Return the distance from a point to the wall (m); negative beyond it."""
        return self.offset - math.cos(self.normal) * x - math.sin(self.normal) * y

    @property
    def heading(self) -> float:
        """Direction of travel with the wall on the left (rad)."""
        return math.remainder(self.normal - math.pi / 2, math.tau)


@dataclass(frozen=True, slots=True)
class Cone:
    """Sound cone of the sonars.

    Attributes:
        half: half of the opening angle (rad); 0 for a beam.
        critical: maximum angle from the wall's normal for sound to return (rad).
    """

    half: float
    critical: float

    def shares(self, axis: Array, normal: Array) -> tuple[Array, Array, NDArray[np.bool_]]:
        """Return the ranges measured to walls, as a fraction of the wall distance.

        Args:
            axis: sonar axes (rad).
            normal: wall normals (rad).

        Returns:
            Range over distance; the derivative of its logarithm by the wall's direction (1/rad); whether sound
            returns.
        """
        off = normal - axis
        off -= math.tau * np.rint(off * (1.0 / math.tau))
        slope = np.abs(off)
        slope -= self.half
        np.maximum(slope, 0.0, out=slope)
        heard = slope <= self.critical + 0.05  # error of the critical angle of a wall, rad
        slope *= heard
        np.tan(slope, out=slope)
        share = slope * slope
        share += 1.0
        return np.sqrt(share, out=share), np.copysign(slope, off, out=slope), heard

    def hears(self, axis: float, normal: float) -> bool:
        """Whether a sonar hears a wall with this normal."""
        return abs(math.remainder(normal - axis, math.tau)) - self.half <= self.critical


ECHO: Final = ("x", "y", "axis", "range", "sonar", "travelled", "time")
"""Columns of the echoes: position (m) and axis (rad) of the sonar in odom, range (m), sonar number; distance travelled
(m) and time (s) at reception."""


class EstimateFit(NamedTuple):
    """Line with its quality of fit."""

    line: WallEstimate
    explained: int
    """Number of echoes within ``TIGHT``."""
    sigma: tuple[float, float]
    """Standard deviations of direction (rad) and distance from the robot (m)."""


def deviation(ranges: Array) -> Array:
    """Return the standard deviation of ranges (m)."""
    # 0.005: standard deviation of a range, m; 0.01 of the range is added in quadrature
    return np.asarray(np.hypot(0.005, 0.01 * ranges))


def residuals(echoes: Array, line: WallEstimate, cone: Cone) -> Array:
    """Return measured minus expected range of every echo (n,), in standard deviations; inf where none is expected."""
    distance = line.offset - math.cos(line.normal) * echoes[:, 0] - math.sin(line.normal) * echoes[:, 1]
    share, _, heard = cone.shares(echoes[:, 2], np.array(line.normal))
    return np.where(heard, (echoes[:, 3] - distance * share) / deviation(echoes[:, 3]), np.inf)


def refine(echoes: Array, before: WallEstimate, at: tuple[float, float], cone: Cone) -> EstimateFit:
    """Fit a line to echoes, starting from an estimate that also holds the fit where echoes carry little information.

    Args:
        echoes: (n, 7), see ``ECHO``.
        before: previous estimate.
        at: position of the robot (m), whose distance to the line is estimated.
        cone: sound cone of the sonars.
    """
    # (0.05, 0.03): standard deviations of the estimate before: rad, m
    normals, distances, cost, information = _fitted(
        echoes, np.array([before.normal]), np.array([before.distance(*at)]), at, cone, (0.05, 0.03), NEWTON_STEPS[0]
    )
    return _best(echoes, normals, distances, cost, information, at, cone)


def search(echoes: Array, at: tuple[float, float], cone: Cone, before: WallEstimate | None = None) -> EstimateFit:
    """Fit a line to at least three echoes: the best of several start directions and of a previously found line.

    The previous line does not hold the fit, but without it a search may miss the best line and find a line of other
    echoes. See ``refine``.
    """
    normals = np.linspace(-math.pi, math.pi, GUESSES[0], endpoint=False)
    sample = echoes
    sampled = 40  # maximum number of echoes in the fits of the guesses, sampled evenly
    if len(echoes) > sampled:  # not every so many-th one, which could all be of one sonar
        sample = echoes[np.linspace(0, len(echoes) - 1, sampled).astype(int)]
    offsets = sample[:, :2] - at
    along = offsets[:, 0] * np.cos(normals)[:, None] + offsets[:, 1] * np.sin(normals)[:, None]
    share, _, _ = cone.shares(sample[:, 2], normals[:, None])
    distances = np.median(sample[:, 3] / share + along, axis=1)
    normals, distances, cost, _ = _fitted(sample, normals, distances, at, cone, FREE, NEWTON_STEPS[1])
    best = _distinct(normals, distances, np.where(distances > 0.0, cost, np.inf))
    normals, distances = normals[best], distances[best]
    if before is not None:
        normals, distances = np.append(normals, before.normal), np.append(distances, before.distance(*at))
    return _best(echoes, *_fitted(echoes, normals, distances, at, cone, FREE, NEWTON_STEPS[2]), at, cone)


def _distinct(normals: Array, distances: Array, cost: Array) -> list[int]:
    """Return the best guesses, without those that lead to the same line as a better guess."""
    found: list[tuple[float, float]] = []
    best = []
    distinct = 0.05  # least difference between these, rad or m
    for i in np.argsort(cost, kind="stable").tolist():
        normal, distance = float(normals[i]), float(distances[i])
        if any(abs(math.remainder(normal - n, math.tau)) < distinct and abs(distance - d) < distinct for n, d in found):
            continue
        found.append((normal, distance))
        best.append(i)
        if len(best) == GUESSES[1]:
            break
    return best


def _fitted(
    echoes: Array,
    normals: Array,
    distances: Array,
    at: tuple[float, float],
    cone: Cone,
    inertia: tuple[float, float],
    steps: int,
) -> tuple[Array, Array, Array, Array]:
    """Return directions, distances, costs (k,), and information (k, 3) of k fits after some steps."""
    x, y, axis, ranges = np.ascontiguousarray(echoes[:, :4].T)
    x, y = x - at[0], y - at[1]
    weight = 1.0 / deviation(ranges) ** 2
    # 2.0: scale of Cauchy's weights: residual, in standard deviations, that halves the weight of an echo
    damping = weight / 2.0**2
    first = np.stack([normals, distances])
    lines = first
    held_a, held_d = 1.0 / inertia[0] ** 2, 1.0 / inertia[1] ** 2
    terms = np.empty((len(normals), 3, len(echoes)))
    """Derivatives of the range by direction and distance, and the residual, of every fit and echo."""
    across, step = np.empty((len(normals), len(echoes))), np.empty_like(first)
    longest = 0.3  # greatest step of a fit, rad and m
    # The arrays are small, so the number of calls costs the time; most calls write into existing arrays.
    for _ in range(steps):
        angle = lines[0][:, None]
        c, s = np.cos(angle), np.sin(angle)
        share, slope, heard = cone.shares(axis, angle)
        far = lines[1][:, None] - c * x
        far -= s * y
        slope *= far
        np.multiply(s, x, out=across)
        across -= c * y
        across += slope
        np.multiply(across, share, out=terms[:, 0])
        terms[:, 1] = share
        far *= share
        missing = np.where(heard, ranges - far, 0.5)  # residual of an echo from a direction without an expected echo, m
        terms[:, 2] = missing
        doubt = missing * missing
        doubt *= damping
        doubt += 1.0
        kept = heard * weight
        kept /= doubt
        sums = (terms * kept[:, None]) @ terms.transpose(0, 2, 1)
        aa, ad, dd, ga, gd = sums[:, 0, 0], sums[:, 0, 1], sums[:, 1, 1], sums[:, 0, 2], sums[:, 1, 2]
        if inertia != FREE:
            aa, dd = aa + held_a, dd + held_d
            ga, gd = ga + held_a * (first[0] - lines[0]), gd + held_d * (first[1] - lines[1])
        product = aa * dd
        determinant = np.maximum(product - ad * ad, 1e-12 * (1.0 + product))
        np.subtract(dd * ga, ad * gd, out=step[0])
        np.subtract(aa * gd, ad * ga, out=step[1])
        step /= determinant
        np.maximum(step, -longest, out=step)
        np.minimum(step, longest, out=step)
        lines = lines + step
        if np.abs(step).max() < 1e-4:  # a step of all fits below this, rad and m, is the last one
            break
    cost = np.log1p(missing * missing * damping).sum(1)
    return lines[0], lines[1], cost, np.stack([aa, ad, dd], axis=1)


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
