"""Accept or reject compass headings by the device's flag, the field strength, and the innovation."""

import math
from dataclasses import dataclass, replace
from enum import StrEnum

from monstertruck_estimation.fusion.config import HeadingTrust
from monstertruck_estimation.transforms import wrap_angle
from monstertruck_runtime.clock import SECOND


class HeadingUse(StrEnum):
    """Result of the gate for a heading."""

    USED = "used"
    LEFT_OUT = "left out"
    ANCHORED = "anchored"
    """The heading sets north: the first one, or one after a long steady deviation."""
    HOME = "home"
    """The heading agrees with an earlier north again."""


@dataclass(frozen=True, slots=True)
class CompassGate:
    """State of the gate."""

    anchored: bool = False
    disturbed: bool = False
    """Whether headings are currently rejected."""
    good: int = 0
    """Number of good headings in a row while disturbed."""
    good_since: int = 0
    """Stamp of the first of them (ns)."""
    good_from: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Pose in odom at the first of them (m, rad)."""
    good_residual: float = 0.0
    """Residual of the first of them (rad)."""
    home_good: int = 0
    steady_since: int = 0
    """Start of the steady deviation (ns)."""
    last: float = 0.0
    """Last residual (rad)."""
    home: tuple[float, float] | None = None
    """North and its variance before the disturbance (rad, rad^2)."""
    field: float = 0.0
    """Mean field strength at the start, or its replacement."""
    fields: int = 0
    """Number of readings in that mean."""
    other_field: float = 0.0
    """Different field strength that holds at present."""
    other_since: int = 0
    """Start of that field strength (ns)."""
    other_from: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Pose in odom at its start (m, rad)."""
    rejected: int = 0
    """Number of headings rejected since the start."""
    jump: float = 0.0
    """Jump of the headings, without a turn of the robot, that began the current disturbance (rad); 0 without one."""
    level: float = 0.0
    """Mean residual since the jump (rad), over about 1 m and rad."""
    level_at: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Pose in odom at the last heading (m, rad)."""


@dataclass(frozen=True, slots=True)
class HeadingInnovation:
    """A heading compared with the filter's state."""

    stamp: int
    place: tuple[float, float, float]
    """Pose in odom (m, rad)."""
    residual: float
    """Residual against the current north (rad)."""
    variance: float
    """Variance of the residual, without the heading's own noise."""
    yaw_variance: float
    north: tuple[float, float]
    """Current north and its variance (rad, rad^2)."""
    local: float
    """Estimated local deviation (rad)."""
    flagged: bool
    """Whether the device flags the heading as disturbed."""
    taken_back: bool
    """Whether a disturbance was detected soon after this heading."""
    field: float | None
    jump: float | None = None
    """Jump of the headings at this one (rad); 0 if a turn of the robot may explain it.

    If None, ``turn_known`` decides whether the residual is a jump.
    """
    turn_known: float = 0.0
    """Maximum residual that a turn of the robot, rather than a compass error, may explain (rad)."""


def gate_heading(
    gate: CompassGate, innovation: HeadingInnovation, config: HeadingTrust
) -> tuple[HeadingUse, CompassGate]:
    """Return the use of a heading and the next state of the gate.

    A heading is off if its innovation exceeds ``config.gate`` standard deviations (chi-square gating). It is disturbed
    if the device flags it, if the field strength differs from the one at the start, or if the local deviation has crept
    beyond the gate. Neither excludes the compass for ever:

    - ``config.recover`` good headings over ``config.regain`` readmit it; even next to a magnet there is a place where
      the heading is right.
    - A heading that is steadily off for ``config.steady_time`` becomes a new north: odometry measures a turn better,
      and the compass only judges the field around it.

    A disturbance that began with a jump, without a turn of the robot, ends when the headings jump back or with a new
    north.
    """
    gate, disturbed = _field(gate, innovation, config)
    gate = _jumped(gate, innovation)
    crept = not gate.disturbed and abs(innovation.local) > config.gate * config.local
    # The first heading is always used: without it there is no north to return to.
    if disturbed or crept or (innovation.taken_back and gate.anchored):
        return HeadingUse.LEFT_OUT, _off(gate, innovation, steady=False)
    if not gate.anchored:
        return HeadingUse.ANCHORED, replace(gate, anchored=True, disturbed=False, good=0, jump=0.0)
    near = abs(innovation.residual) <= config.gate * (innovation.variance + config.noise**2) ** 0.5
    if near and not gate.jump:
        gate, enough = _good(gate, innovation, config) if gate.disturbed else (gate, True)
        if not enough:
            return HeadingUse.LEFT_OUT, replace(gate, rejected=gate.rejected + 1, steady_since=innovation.stamp)
        return HeadingUse.USED, replace(gate, disturbed=False, good=0, home_good=0)
    if not gate.disturbed and innovation.jump is None and abs(innovation.residual) > innovation.turn_known:
        gate = replace(gate, jump=innovation.residual, level=innovation.residual, level_at=innovation.place)
    return _far(gate, innovation, config)


def _jumped(gate: CompassGate, innovation: HeadingInnovation) -> CompassGate:
    """Return the gate after the start or end of a jump at this heading.

    A jump ends when the headings return by more than half of it within a distance over which dead reckoning stays
    accurate. Residuals alone cannot show this: without headings the yaw soon becomes so uncertain that a turn of the
    robot might explain a lasting jump.
    """
    if innovation.jump is not None:
        # If headings were withdrawn, the previous disturbance may not have ended yet.
        jump = gate.jump + innovation.jump
        jump = 0.0 if abs(jump) < abs(innovation.jump) / 2 else jump
        return replace(gate, jump=jump, level=innovation.residual, level_at=innovation.place)
    if not gate.jump:
        return gate
    (x, y, yaw), (x0, y0, yaw0) = innovation.place, gate.level_at
    change = wrap_angle(innovation.residual - gate.level)
    if change * gate.jump < 0 and abs(change) > abs(gate.jump) / 2:
        return replace(gate, jump=0.0)
    # 1.0: distance (m) and turn (rad) over which dead reckoning drifts less than a jump
    share = 1.0 - math.exp(-(math.hypot(x - x0, y - y0) + abs(wrap_angle(yaw - yaw0))) / 1.0)
    return replace(gate, level=wrap_angle(gate.level + share * change), level_at=innovation.place)


def _field(gate: CompassGate, innovation: HeadingInnovation, config: HeadingTrust) -> tuple[CompassGate, bool]:
    """Return the gate with the learned field strength, and whether the reading is disturbed.

    A robot may start near iron: a strength that holds for ``config.steady_time`` and ``config.regain`` metres replaces
    the one from the start.
    """
    if innovation.flagged:
        return gate, True
    if innovation.field is None:
        return gate, False
    # 20: number of headings that determine the undisturbed field strength
    if gate.fields >= 20:
        if abs(innovation.field - gate.field) <= config.field * gate.field:
            return replace(gate, other_field=0.0), False
        if abs(innovation.field - gate.other_field) > config.field * gate.other_field:
            began = replace(
                gate, other_field=innovation.field, other_since=innovation.stamp, other_from=innovation.place
            )
            return began, True
        way = math.hypot(innovation.place[0] - gate.other_from[0], innovation.place[1] - gate.other_from[1])
        held = innovation.stamp - gate.other_since >= config.steady_time * SECOND and way >= config.regain
        return (replace(gate, field=gate.other_field, other_field=0.0), False) if held else (gate, True)
    count = gate.fields + 1
    return replace(gate, fields=count, field=gate.field + (innovation.field - gate.field) / count), False


def _good(gate: CompassGate, innovation: HeadingInnovation, config: HeadingTrust) -> tuple[CompassGate, bool]:
    """Return the gate after a good heading during a disturbance, and whether enough headings agree."""
    if not gate.good or abs(wrap_angle(innovation.residual - gate.good_residual)) > 2 * config.local:
        gate = replace(
            gate,
            good=0,
            good_since=innovation.stamp,
            good_from=innovation.place,
            good_residual=innovation.residual,
        )
    gate = replace(gate, good=gate.good + 1)
    (x, y, yaw), (x0, y0, yaw0) = innovation.place, gate.good_from
    far = math.hypot(x - x0, y - y0) + abs(wrap_angle(yaw - yaw0)) >= config.regain
    long = innovation.stamp - gate.good_since >= config.steady_time * SECOND
    return gate, gate.good >= config.recover and (far or long)


def _far(gate: CompassGate, innovation: HeadingInnovation, config: HeadingTrust) -> tuple[HeadingUse, CompassGate]:
    if gate.home is not None:
        north, variance = gate.home
        off = wrap_angle(innovation.residual + north - innovation.north[0])
        near = abs(off) <= config.gate * (innovation.yaw_variance + variance + config.local**2 + config.noise**2) ** 0.5
        gate = replace(gate, home_good=gate.home_good + 1 if near else 0)
        if gate.home_good >= config.recover:
            return HeadingUse.HOME, replace(gate, disturbed=False, good=0, home_good=0, jump=0.0)
    steady = abs(wrap_angle(innovation.residual - gate.last)) <= config.local
    gate = _off(gate, innovation, steady=steady)
    if innovation.stamp - gate.steady_since < config.steady_time * SECOND:
        return HeadingUse.LEFT_OUT, gate
    home = gate.home or innovation.north
    return HeadingUse.ANCHORED, replace(gate, disturbed=False, good=0, home=home, home_good=0, jump=0.0)


def _off(gate: CompassGate, innovation: HeadingInnovation, *, steady: bool) -> CompassGate:
    since = gate.steady_since if steady and gate.disturbed else innovation.stamp
    return replace(
        gate,
        disturbed=True,
        good=0,
        steady_since=since,
        last=innovation.residual if not steady else gate.last,
        rejected=gate.rejected + 1,
    )
