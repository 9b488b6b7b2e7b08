"""What a truck on a run would do at every place: heading, turn, sideslip and steering; the trackers' reference.

Headings come from chords, so points rounded to millimetres do not shake the wheels. A truck with one way of steering
turns about the line through the point ``a`` of its middle that never slips sideways: the fixed axle's, or the middle
between two axles that counter-steer. There sin(sideslip of C) = -a * turn, hence its heading follows that of the path
through a first-order lag as long as ``a`` is from C; where that point leads, the lag runs against the travel.
"""

import math
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from monstertruck_kinematics.truck import FourWheelSteering
from monstertruck_planners.track.line import Run
from monstertruck_schemas.plan import Steering

Array = NDArray[np.float64]

STEP: Final = 0.025
"""Spacing of the reference and half the chord a heading is taken from, m."""
MOST: Final = 5000
"""Greatest number of reference points of a run."""
QUANTILES: Final = -np.log1p(-(np.arange(16) + 0.5) / 16)
"""Of the exponential distribution: a mean over them is a first-order lag."""


class Reference(NamedTuple):
    """Values at places of a run, arrays of one shape."""

    heading: Array
    """Direction of the body-forward motion, rad: the path's tangent, turned round backwards."""
    yaw: Array
    """Of the body, rad."""
    slip: Array
    """Heading less yaw: sideslip at C, rad."""
    turn: Array
    """Yaw per metre of forward motion, 1/m."""
    curvature: Array
    """Of the path in the direction of travel, 1/m."""


class Spot(NamedTuple):
    """``Reference`` at one place."""

    heading: float
    yaw: float
    slip: float
    turn: float
    curvature: float


class Course:
    """Reference along one run.

    Args:
        run: part of a line.
        geometry: the truck's.
        steering: where the run does not say.
    """

    def __init__(self, run: Run, geometry: FourWheelSteering, steering: Steering) -> None:
        self._run = run
        self._default: Steering = steering
        count = min(max(math.ceil(run.end / STEP), 4), MOST) + 1
        self._s = np.linspace(0.0, run.end, count)
        tangent, curvature = _bends(run, self._s)
        heading = tangent if run.direction > 0 else tangent + math.pi
        self.given = bool(run.steering)
        names: list[Steering] = sorted(set(run.steering)) if self.given else [steering]
        number = {mode: i for i, mode in enumerate(names)}
        modes = np.array([number[mode] for mode in run.steering] if self.given else [0])
        self._changes = run.vertices[np.flatnonzero(np.diff(modes)) + 1]
        modes = modes[self._step_at(self._s)] if self.given else np.zeros(count, np.intp)
        yaw, turn = heading.copy(), run.direction * curvature
        for mode in names:
            where = modes == number[mode]
            if self.given and mode in ("crab", "hybrid"):
                own = np.interp(self._s, run.vertices, run.yaws)
                yaw[where] = own[where]
                turn[where] = (run.direction * np.gradient(own, self._s))[where]
            elif mode != "crab":
                lagged, bend = self._lagged(heading, curvature, _slip_free(mode, geometry))
                yaw[where], turn[where] = lagged[where], bend[where]
        slip = np.remainder(heading - yaw + math.pi, math.tau) - math.pi
        self._table = Reference(heading, yaw, slip, turn, curvature)
        self._rows = np.column_stack((self._s, *self._table))
        side = np.tan(slip)
        lever = turn / np.cos(slip)
        self._axles = np.arctan([side + geometry.l_f * lever, side - geometry.l_r * lever])

    @property
    def places(self) -> Array:
        """Metres from the run's beginning where the reference was computed: from 0 to the end of the way."""
        return self._s

    def steering(self, s: float) -> Steering:
        """How the axles steer at ``s`` metres."""
        return self._modes(np.array([s]))[0] if self.given else self._default

    def steerings(self, s: Array) -> list[Steering]:
        """The same at several places."""
        return self._modes(s) if self.given else [self._default] * len(s)

    def at(self, s: Array) -> Reference:
        """Values at ``s`` metres; outside the run those of its ends."""
        return Reference(*(np.asarray(np.interp(s, self._s, column)) for column in self._table))

    def spot(self, s: float) -> Spot:
        """The same at one place."""
        last = len(self._rows) - 1
        i = int(self._s.searchsorted(s, "right")) - 1
        if not 0 <= i < last:
            return Spot(*self._rows[min(max(i, 0), last)].tolist()[1:])
        (begin, *here), (end, *there) = self._rows[i : i + 2].tolist()
        width, past = end - begin, s - begin
        return Spot(*[(b - a) / width * past + a for a, b in zip(here, there, strict=True)])

    def turned(self, ahead: float) -> Array:
        """How far the axles have to turn in the ``ahead`` metres after each of the places, rad; the further one's."""
        change = [np.abs(np.interp(self._s + ahead, self._s, axle) - axle) for axle in self._axles]
        return np.asarray(np.maximum(*change))

    def section_end(self, s: float) -> float:
        """Where the steering changes next, m; the end of the way if it does not."""
        i = int(self._changes.searchsorted(s, "right"))
        return float(self._changes[i]) if i < len(self._changes) else self._run.end

    def _modes(self, s: Array) -> list[Steering]:
        return [self._run.steering[i] for i in self._step_at(s).tolist()]

    def _step_at(self, s: Array) -> NDArray[np.intp]:
        """Index of the run's step at each of the places."""
        run = self._run
        index = np.searchsorted(run.vertices, np.remainder(s, run.length) if run.end > run.length else s, side="right")
        return np.clip(index - 1, 0, len(run.steering) - 1)

    def _lagged(self, heading: Array, curvature: Array, a: float) -> tuple[Array, Array]:
        """Yaw and turn of a body that does not slip sideways at its point ``a``."""
        direction = self._run.direction
        if abs(a) < 1e-9:
            return heading, direction * curvature
        back = math.copysign(abs(a), -a * direction)
        yaw, turn = np.zeros_like(heading), np.zeros_like(heading)
        for quantile in QUANTILES.tolist():
            s = self._s - back * quantile
            inside = np.clip(s, 0.0, self._s[-1])
            bend = np.interp(inside, self._s, curvature)
            yaw += np.interp(inside, self._s, heading) + bend * (s - inside)
            turn += bend
        slip = np.arcsin(np.clip(heading - yaw / len(QUANTILES), -1.0, 1.0))
        return heading - slip, direction * turn / len(QUANTILES)


def _slip_free(mode: Steering, geometry: FourWheelSteering) -> float:
    """Where the point is that never slips sideways, x in m."""
    if mode == "front":
        return -geometry.l_r
    return geometry.l_f if mode == "rear" else 0.5 * (geometry.l_f - geometry.l_r)


def _bends(run: Run, s: Array) -> tuple[Array, Array]:
    """Tangent (continuous) and curvature from chords."""
    half = min(STEP, run.end / 4)
    at = np.clip(s, half, run.end - half)
    tangent = np.unwrap(_chord(run, at - half, at + half))
    middle = np.clip(s, 2 * half, run.end - 2 * half)
    change = _chord(run, middle, middle + 2 * half) - _chord(run, middle - 2 * half, middle)
    curvature = (np.remainder(change + math.pi, math.tau) - math.pi) / (2 * half)
    return tangent + curvature * (s - at), curvature


def _chord(run: Run, begin: Array, end: Array) -> Array:
    x, y = (run.points(end) - run.points(begin)).T
    return np.asarray(np.arctan2(y, x))
