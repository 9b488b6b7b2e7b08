"""Wheels as linear constraints on the body's velocity (vx, vy, wz), and the mobility of any set of them.

Every wheel is at (x, y) in the body frame and rolls along ``heading`` (rad from the body's x axis). In polar form
(l, alpha; plane angle beta) that is heading = alpha + beta - pi/2, and the rows below become the textbook's
[sin(alpha+beta), -cos(alpha+beta), -l cos beta] (rolling) and [cos(alpha+beta), sin(alpha+beta), l sin beta] (no slip).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from monstertruck_kinematics.elementary import Array, KinematicsError, require_finite, require_positive


@dataclass(frozen=True)
class Wheel:
    """What all wheels share.

    Args:
        name: unique within a robot; errors use it.
        x: forward position, m.
        y: leftward position, m.
        radius: m.
        heading: direction of rolling, rad.

    Raises:
        KinematicsError: a figure is not finite, or the radius not above zero.
    """

    name: str
    x: float
    y: float
    radius: float
    heading: float = 0.0

    def __post_init__(self) -> None:
        for field in ("x", "y", "heading"):
            require_finite(f"wheel {self.name}: {field}", getattr(self, field))
        require_positive(f"wheel {self.name}: radius", self.radius)

    def row(self, direction: float) -> Array:
        """Row (3,) whose product with (vx, vy, wz) is the wheel point's speed along ``direction``, m/s."""
        c, s = math.cos(direction), math.sin(direction)
        return np.array([c, s, self.x * s - self.y * c])

    @property
    def rolling_row(self) -> Array:
        """Row (3,): its product with the body's velocity is ``rolling_gain`` times the wheel's rate."""
        return self.row(self.heading)

    @property
    def rolling_gain(self) -> float:
        """Metres per radian of wheel rotation in its rolling row."""
        return self.radius

    @property
    def sliding_row(self) -> Array | None:
        """Row (3,) whose product with the body's velocity must be 0, or None if the wheel may move sideways."""
        return self.row(self.heading + math.pi / 2.0)


@dataclass(frozen=True)
class FixedWheel(Wheel):
    """Wheel whose plane is fixed to the body."""


@dataclass(frozen=True)
class SteeredWheel(Wheel):
    """Centred orientable wheel, currently along ``heading``.

    Args:
        group: wheels of one group are turned by one motor and stay parallel (a synchro drive's belt); None is alone.
    """

    group: str | None = None


@dataclass(frozen=True)
class CasterWheel(Wheel):
    """Off-centred orientable wheel: its point of contact trails the steering axis, so it never constrains the body.

    Args:
        offset: from the steering axis (x, y) back to the point of contact, m.
    """

    offset: float = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        require_positive(f"wheel {self.name}: offset", self.offset)

    @property
    def sliding_row(self) -> Array | None:
        """None: sideways motion turns the caster instead."""
        return None

    def steering_rate(self, twist: Sequence[float]) -> float:
        """Swivel rate of the caster, rad/s, relative to the body, when the body moves with (vx, vy, wz).

        From its no-slip row: side speed of the axis - offset (wz + rate) = 0, the contact point trailing. (The
        textbook writes + d: it looks from the axis towards the contact point.)
        """
        sideways = float(self.row(self.heading + math.pi / 2.0) @ np.asarray(twist))
        return sideways / self.offset - twist[2]


@dataclass(frozen=True)
class SwedishWheel(Wheel):
    """Wheel with free rollers on its rim.

    Args:
        roller: gamma: rollers let it slide freely across ``heading + roller``; 0 for the 90 deg wheel of an omni
            robot, +-pi/4 for a mecanum wheel.
    """

    roller: float = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        require_finite(f"wheel {self.name}: roller", self.roller)
        if abs(math.cos(self.roller)) < 1e-9:
            raise KinematicsError(
                f"wheel {self.name}: roller is {self.roller}: a wheel with rollers at +-pi/2 cannot drive"
            )

    @property
    def rolling_row(self) -> Array:
        """Row along the direction without rolling of the rollers."""
        return self.row(self.heading + self.roller)

    @property
    def rolling_gain(self) -> float:
        """R cos(gamma)."""
        return self.radius * math.cos(self.roller)

    @property
    def sliding_row(self) -> Array | None:
        """None: the rollers allow sideways motion."""
        return None


def checked(wheels: Sequence[Wheel]) -> tuple[Wheel, ...]:
    """The wheels, if they can be one robot's.

    Raises:
        KinematicsError: no wheels, or two of one name.
    """
    if not wheels:
        raise KinematicsError("wheels is empty: expected at least one wheel")
    names = [wheel.name for wheel in wheels]
    for name in names:
        if names.count(name) > 1:
            raise KinematicsError(f"wheel {name}: two wheels have the same name")
    return tuple(wheels)


def rolling_matrix(wheels: Sequence[Wheel]) -> Array:
    """(n, 3) matrix from body velocity to the wheels' own rates, rad/s."""
    return np.array([wheel.rolling_row / wheel.rolling_gain for wheel in checked(wheels)])


def sliding_matrix(wheels: Sequence[Wheel]) -> Array:
    """(k, 3) rows of the k wheels that forbid sideways motion (C*)."""
    rows = [wheel.sliding_row for wheel in wheels]
    return np.array([row for row in rows if row is not None]).reshape(-1, 3)


IcrKind = Literal["none", "point", "infinite", "line", "anywhere"]


@dataclass(frozen=True)
class Mobility:
    """Mobility of a set of wheels at its current steering angles.

    Attributes:
        mobility: delta_m = 3 - rank C*: velocities free at once.
        steerability: delta_s: further freedoms that steering opens.
        icr_kind: none (cannot move), point (one ICR), infinite (straight motion only), line (anywhere on
            a line) or anywhere.
        icr: (x, y), m, if it is one point.
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


def analyse(wheels: Sequence[Wheel], tolerance: float = 1e-9) -> Mobility:
    """Mobility of the wheels at their current headings.

    Lengths are scaled by the robot's size about its middle, so neither the unit nor the frame's origin matters.
    Steering alone can align every single centred wheel with any body velocity that the fixed wheels allow, so the
    manoeuvrability is the dimension of those velocities; wheels of one parallel group exclude turning.

    Args:
        wheels: any wheels; steered ones may contradict each other (then nothing moves: mobility 0).
        tolerance: singular value, relative to the largest, threshold of dependent rows; larger for headings
            that were rounded.

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
    """Mean position of the wheels and the largest distance from it (1 if all are at one place)."""
    places = np.array([[wheel.x, wheel.y] for wheel in wheels])
    middle = places.mean(axis=0)
    size = float(np.hypot(*(places - middle).T).max())
    return middle, size if size > 0.0 else 1.0


def _scaled(rows: Array, middle: Array, size: float) -> Array:
    """Rows about the middle with a dimensionless yaw column."""
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
    """Whether some group of parallel steered wheels has wheels at more than one place."""
    places: dict[str, set[tuple[float, float]]] = {}
    for wheel in wheels:
        if isinstance(wheel, SteeredWheel) and wheel.group is not None:
            places.setdefault(wheel.group, set()).add((wheel.x, wheel.y))
    return any(len(group) > 1 for group in places.values())
