"""Assisted driving: steers an operator's motion to the nearest curvature whose swept ground is free.

Assisted driving never increases the operator's speed and never changes a request for standstill. All checks of the gate
treat the changed motion as if the operator had requested it.
"""

import math
from collections.abc import Iterator, Sequence
from typing import Final

import numpy as np

from monstertruck_kinematics.elementary import Array
from monstertruck_planners.collision import Footprint
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import DriveForm, DriveRequest
from monstertruckd.gate.approach import stopping
from monstertruckd.gate.checks import Check, GateView, PaceLimit
from monstertruckd.gate.motion import Course
from monstertruckd.gate.obstacles import ObstacleGuard

CHOICES: Final = 8
"""Number of turns to each side that are compared."""


def nearest_free(turns: Array, free: Array, needed: float) -> float:
    """Return the smallest turn that leaves ``needed`` metres free, or else the turn that leaves most.

    Args:
        turns: deviations from the requested motion, shape (n,), in any unit.
        free: free distance for each turn (m), shape (n,).
        needed: required free distance (m).
    """
    free = np.minimum(free, needed)
    best = np.flatnonzero(free >= free.max() - 1e-9)
    return float(turns[best[np.argmin(np.abs(turns[best]))]])


def free_distances(twists: Array, footprint: Footprint, margin: float, points: Array) -> Array:
    """Return the distance a body can travel along arcs of constant twist before it touches a point; +inf if never.

    Discs cover the footprint. A point inside a disc counts only if the disc moves towards the point.

    Args:
        twists: vx, vy, wz of the base per metre travelled, shape (k, 3).
        footprint: outline of the body.
        margin: clearance added on all sides (m).
        points: points in the base frame (m), shape (n, 2).

    Returns:
        Distances (m), shape (k,).
    """
    result = np.full(len(twists), math.inf)
    places, radius = footprint.covering_discs()
    radius += margin
    vx, vy, turn = twists.T
    # 1e-3: a straight line is computed as a circle of 1000 m, 1 mm off after 1.4 m
    turn = np.where(np.abs(turn) < 1e-3, 1e-3, turn)
    centre = np.column_stack((-vy / turn, vx / turn))
    # A disc meets the points in the ring that it sweeps around the centre, and no others.
    square = (points**2).sum(axis=1) - 2.0 * centre @ points.T + (centre**2).sum(axis=1)[:, None]
    sizes = np.hypot(places - centre[:, :1], centre[:, 1:])
    inner, outer = np.maximum(sizes.min(axis=1) - radius, 0.0), sizes.max(axis=1) + radius
    # 1e-6: rounding of a square of 1000 m, m^2
    of, met = np.nonzero((square >= (inner**2 - 1e-6)[:, None]) & (square <= (outer**2 + 1e-6)[:, None]))
    points, centre, turn, vx, vy = points[met], centre[of], turn[of], vx[of], vy[of]
    arms = points - centre
    reach, bearing = np.hypot(*arms.T), np.arctan2(*arms.T[::-1])
    for disc in places.tolist():
        arm = np.array((disc, 0.0)) - centre
        size, begin = np.hypot(*arm.T), np.arctan2(*arm.T[::-1])
        cosine = (reach**2 + size**2 - radius**2) / np.maximum(2.0 * reach * size, 1e-12)
        ahead = np.mod(np.sign(turn) * (bearing - begin), math.tau) - np.arccos(np.clip(cosine, -1.0, 1.0))
        distance = np.where(cosine <= 1.0, np.maximum(ahead, 0.0) / np.abs(turn), math.inf)
        dx, dy = points[:, 0] - disc, points[:, 1]
        towards = vx * dx + (vy + turn * disc) * dy > 0.0
        inside = np.hypot(dx, dy) <= radius
        np.minimum.at(result, of, np.where(inside, np.where(towards, 0.0, math.inf), distance))
    return result


class Assist(Check):
    """Adjusts the steering of operators' requests while ``gate.assist.on``; as a check, it reports when it does so.

    Args:
        view: limits, samples and motion.
        guard: measured and remembered points.
    """

    reasons = (Reason.ASSISTED,)

    def __init__(self, view: GateView, guard: ObstacleGuard) -> None:
        super().__init__(view)
        self._guard = guard
        self._turned = False
        self._chosen: tuple[tuple[float, ...], float] = ((), 0.0)
        """Inputs of the latest choice, and the chosen turn (rad)."""

    def instead(self, request: DriveRequest | None, now: int) -> DriveRequest | None:
        """Return the request to drive, with an assisted turn; None if no request can be assisted.

        The second control confirms only the ground along the requested motion.
        """
        self._turned = False
        view = self.view
        if (
            request is None
            or request.form is not DriveForm.AXLES
            or request.neutral
            or request.unseen
            or view.chassis.freedom == "parallel"
        ):
            return request
        if not view.samples.scan_fresh(now):
            return request
        # 0.01 m/s and rad: noise of a stick, which must not cost a comparison in every tick
        asked = (round(value, 2) for value in (request.speed, request.front, request.rear))
        depends = (*asked, view.config.assist.horizon, self._guard.stamp)
        if depends != self._chosen[0]:
            self._chosen = depends, self._choose(request, now)
        turn = self._chosen[1]
        self._turned = turn != 0.0
        front, rear = self._axles(request, turn)
        return request.model_copy(update={"front": front, "rear": rear}) if self._turned else request

    def _choose(self, request: DriveRequest, now: int) -> float:
        """Return the turn to add to each requested axle angle (rad)."""
        config, bicycle = self.view.config, self.view.chassis.bicycle
        # Both ends turn the axles to their limit, whatever the request.
        most = config.angle + max(abs(request.front), abs(request.rear))
        turns = most * np.arange(-CHOICES, CHOICES + 1) / CHOICES
        ahead = math.copysign(1.0, request.speed)
        speed = min(abs(request.speed), config.speed if ahead > 0 else config.reverse_speed)
        twists = [bicycle.body_twist(ahead, *self._axles(request, turn)) for turn in turns.tolist()]
        slowing = stopping(speed, self._guard.delay(now), config.obstacle.deceleration)
        needed = slowing + config.obstacle.ahead + config.assist.horizon
        footprint, margin = self.view.footprint, config.obstacle.side_clearance
        points = self._guard.points(needed + footprint.circumscribed_radius + margin, reverse=ahead < 0)
        if free_distances(np.array(twists[CHOICES : CHOICES + 1]), footprint, margin, points)[0] >= needed:
            return 0.0
        return nearest_free(turns, free_distances(np.array(twists), footprint, margin, points), needed)

    def _axles(self, request: DriveRequest, turn: float) -> tuple[float, float]:
        """Return the requested axle angles, each turned further to one side, within the limits."""
        most, chassis = self.view.config.angle, self.view.chassis
        front = min(max(request.front + turn, -most), most)
        if chassis.freedom != "both":
            return front, request.rear
        return front, min(max(request.rear - turn, -most), most)

    def limit(self, now: int, courses: Sequence[Course] | None) -> Iterator[PaceLimit]:
        """Report that the steering is assisted, without a speed limit."""
        if courses and self._turned:
            yield PaceLimit(Reason.ASSISTED, self.view.motion.max_pace(courses[0][0]))
