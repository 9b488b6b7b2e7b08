"""Shortest motions without obstacles: Reeds-Shepp, and the same with crab moves for two steered axles. Compiled."""

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from monstertruck_planners.route import crab_words, reeds_shepp_words
from monstertruck_planners.route.motion import MotionPath
from monstertruck_runtime.errors import InputError
from monstertruck_schemas.plan import Steering

Array = NDArray[np.float64]


@dataclass(frozen=True)
class ReedsShepp:
    """Cheapest motions between two poses: arcs of one radius, straight lines and, with a crab angle, translations.

    With the default costs a motion's cost is its length: the exact Reeds-Shepp metric.

    Args:
        radius: turning radius of the reference point, m.
        crab_angle: largest angle between heading and a translation, rad; 0: the truck cannot crab.
        reverse_cost: of a metre backward, at least 1.
        cusp_cost: of a change of direction, m, at least 0.
        crab_cost: factor on a translation's cost, at least 1.
        steering: how arcs and lines are steered, see ``MotionPath``.
        reference: of the motions, see ``MotionPath``.

    Raises:
        InputError: a number out of these bounds.
    """

    radius: float
    crab_angle: float = 0.0
    reverse_cost: float = 1.0
    cusp_cost: float = 0.0
    crab_cost: float = 1.0
    steering: Steering = "counter"
    reference: float = 0.0
    weights: Array = field(init=False, repr=False, compare=False)
    """The costs as the compiled words take them."""

    def __post_init__(self) -> None:
        if not (
            0.0 < self.radius < math.inf
            and 0.0 <= self.crab_angle < math.pi / 2
            and 1.0 <= self.reverse_cost < math.inf
            and 0.0 <= self.cusp_cost < math.inf
            and 1.0 <= self.crab_cost < math.inf
        ):
            raise InputError(
                f"Reeds-Shepp radius {self.radius} m, crab angle {self.crab_angle} rad, costs of reverse, cusp, crab "
                f"{self.reverse_cost}, {self.cusp_cost} m, {self.crab_cost}: expected a radius above 0, an angle from "
                "0 to below 90 deg, costs from 1, 0 and 1"
            )
        weights = np.array([self.reverse_cost, self.cusp_cost / self.radius, self.crab_cost])
        object.__setattr__(self, "weights", weights)

    def distance(self, starts: ArrayLike, goals: ArrayLike) -> Array:
        """Cost of the best motion of every pair, m.

        Args:
            starts: shape (n, 3) or (3,).
            goals: the same shape, or one of the two is a single pose.

        Returns:
            Shape (n,).
        """
        a, b = np.broadcast_arrays(_poses(starts), _poses(goals))
        if self.crab_angle:
            return crab_words.distances(a, b, self.radius, self.crab_angle, self.weights)
        return reeds_shepp_words.distances(a, b, self.radius, self.weights)

    def path(self, start: ArrayLike, goal: ArrayLike) -> MotionPath:
        """Best motion from one pose to another."""
        a, b = _poses(start)[0], _poses(goal)[0]
        rows = crab_words.rows_between(a, b, self.radius, self.crab_angle, self.weights)
        return MotionPath(a, rows, self.steering, self.reference)


def _poses(values: ArrayLike) -> Array:
    poses = np.ascontiguousarray(np.atleast_2d(np.asarray(values, dtype=np.float64)))
    if poses.ndim != 2 or poses.shape[1] != 3 or not np.isfinite(poses).all():
        raise InputError("Reeds-Shepp: expected finite poses (x, y, yaw)")
    return poses
