"""Mobility of any set of wheels: degrees of mobility, steerability, manoeuvrability, and the turning centre."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from monstertruck_kinematics.elementary import Array
from monstertruck_kinematics.wheels import FixedWheel, SteeredWheel, Wheel, checked, sliding_matrix

RANK_TOLERANCE = 1e-9
"""Singular value, relative to the largest, up to which rows count as dependent."""

IcrKind = Literal["none", "point", "infinite", "line", "anywhere"]


@dataclass(frozen=True)
class Mobility:
    """What a set of wheels can do at its present steering angles.

    Attributes:
        mobility: delta_m = 3 - rank C*: velocities free at once.
        steerability: delta_s: further freedoms that steering opens.
        icr_kind: none (cannot move), point (one turning centre), infinite (straight motion only), line (anywhere on
            a line) or anywhere.
        icr: the turning centre (x, y), m, if it is one point.
        icr_line: a point of the line and its unit direction, if the centres form a line.
        non_holonomic: fewer free velocities than reachable posture dimensions. A synchro drive counts as non-holonomic
            (one velocity, two dimensions), although its point can go anywhere.
    """

    mobility: int
    steerability: int
    icr_kind: IcrKind
    icr: tuple[float, float] | None
    icr_line: tuple[tuple[float, float], tuple[float, float]] | None
    non_holonomic: bool

    @property
    def manoeuvrability(self) -> int:
        """delta_M = delta_m + delta_s."""
        return self.mobility + self.steerability

    @property
    def robot_class(self) -> tuple[int, int]:
        """(delta_m, delta_s)."""
        return self.mobility, self.steerability


def analyse(wheels: Sequence[Wheel], tolerance: float = RANK_TOLERANCE) -> Mobility:
    """Mobility of the wheels at their present headings.

    Lengths are scaled by the robot's size about its middle, so neither the unit nor the frame's origin matters.
    Steering alone can align every single centred wheel with any body velocity that the fixed wheels allow, so the
    manoeuvrability is the dimension of those velocities; wheels of one parallel group exclude turning.

    Args:
        wheels: any wheels; steered ones may contradict each other (then nothing moves: mobility 0).
        tolerance: see ``RANK_TOLERANCE``; larger for headings that were rounded.

    Raises:
        KinematicsError: no wheels, or two of one name.
    """
    wheels = checked(wheels)
    middle, size = _frame(wheels)
    free = _null_space(_scaled(sliding_matrix(wheels), middle, size), tolerance)
    mobility = free.shape[1]
    fixed = _scaled(sliding_matrix([w for w in wheels if isinstance(w, FixedWheel)]), middle, size)
    reach = _null_space(np.vstack([fixed, [[0.0, 0.0, 1.0]]]) if _turns_parallel(wheels) else fixed, tolerance)
    manoeuvrability = reach.shape[1]
    turns = bool(np.abs(reach[2]).max(initial=0.0) > tolerance)
    dimensions = 3 if manoeuvrability >= 2 and turns else manoeuvrability
    icr, line = None, None
    kind: IcrKind
    if mobility == 1:
        vx, vy, turn = free[:, 0]
        kind = "point" if abs(turn) > tolerance else "infinite"
        if kind == "point":
            icr = (float(middle[0] - vy / turn * size), float(middle[1] + vx / turn * size))
    elif mobility == 2:
        kind = "line"
        a, b, c = np.cross(free[:, 0], free[:, 1])
        length = float(np.hypot(a, b))
        # a v + b u + c w = 0 with v = y w, u = -x w: the line a y - b x + c = 0.
        foot = np.array([b, -a]) * (c / length**2) * size + middle
        line = ((float(foot[0]), float(foot[1])), (float(a / length), float(b / length)))
    else:
        kind = "anywhere" if mobility == 3 else "none"
    return Mobility(
        mobility=mobility,
        steerability=max(0, manoeuvrability - max(mobility, 1)),
        icr_kind=kind,
        icr=icr,
        icr_line=line,
        non_holonomic=mobility < dimensions,
    )


def _frame(wheels: Sequence[Wheel]) -> tuple[Array, float]:
    """Middle of the wheels and the largest distance from it (1 if all stand at one place)."""
    places = np.array([[wheel.x, wheel.y] for wheel in wheels])
    middle = places.mean(axis=0)
    size = float(np.hypot(*(places - middle).T).max())
    return middle, size if size > 0.0 else 1.0


def _scaled(rows: Array, middle: Array, size: float) -> Array:
    """Rows about the middle with the turning column made dimensionless."""
    arms = rows[:, 2] - (rows[:, 1] * middle[0] - rows[:, 0] * middle[1])
    return np.column_stack([rows[:, :2], arms / size])


def _null_space(rows: Array, tolerance: float) -> Array:
    """(3, k) orthonormal basis of the velocities that the rows allow."""
    if rows.shape[0] == 0:
        return np.eye(3)
    _, values, basis = np.linalg.svd(rows)
    rank = int((values > tolerance * values[0]).sum())
    return np.asarray(basis[rank:].T)


def _turns_parallel(wheels: Sequence[Wheel]) -> bool:
    """Whether some group of parallel steered wheels stands at more than one place."""
    places: dict[str, set[tuple[float, float]]] = {}
    for wheel in wheels:
        if isinstance(wheel, SteeredWheel) and wheel.group is not None:
            places.setdefault(wheel.group, set()).add((wheel.x, wheel.y))
    return any(len(group) > 1 for group in places.values())
