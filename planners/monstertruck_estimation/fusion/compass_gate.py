"""When a heading may be believed: by the device's own word, the field's strength, and how far it is off."""

import math
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Final

from monstertruck_estimation.fusion.config import HeadingTrust
from monstertruck_estimation.transforms import wrap_angle
from monstertruck_runtime.clock import SECOND

REFERENCE: Final = 20
"""Headings from which the undisturbed strength of the field is taken."""


class Verdict(StrEnum):
    """What becomes of a heading."""

    USED = "used"
    LEFT_OUT = "left out"
    ANCHORED = "anchored"
    """North is wherever it now says: at the start, or after it was steadily off for long."""
    HOME = "home"
    """It agrees with an earlier north again."""


@dataclass(frozen=True, slots=True)
class Gate:
    """What is remembered of the compass."""

    anchored: bool = False
    disturbed: bool = False
    """Headings are left out at present."""
    good: int = 0
    """Good ones in a row while disturbed."""
    good_since: int = 0
    """ns."""
    good_from: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Where that was, m and rad in odom."""
    good_residual: float = 0.0
    """Residual of the first of them, rad."""
    home_good: int = 0
    steady_since: int = 0
    """ns."""
    last: float = 0.0
    """Last residual, rad."""
    home: tuple[float, float] | None = None
    """North, rad, and its variance before the disturbance."""
    field: float = 0.0
    """Mean strength at the start."""
    fields: int = 0
    """Readings it was taken from."""
    rejected: int = 0
    """Headings left out since the start."""


@dataclass(frozen=True, slots=True)
class Evidence:
    """A heading against what is believed."""

    stamp: int
    place: tuple[float, float, float]
    """Pose in odom, m and rad."""
    residual: float
    """Against the present north, rad."""
    variance: float
    """Of the residual, without the heading's own noise."""
    yaw_variance: float
    north: tuple[float, float]
    """Present north, rad, and its variance."""
    local: float
    """Local deviation as it is believed to be, rad."""
    flagged: bool
    """The device calls itself disturbed."""
    taken_back: bool
    """A disturbance was noticed soon after."""
    field: float | None


def judged(gate: Gate, evidence: Evidence, config: HeadingTrust) -> tuple[Verdict, Gate]:
    """What becomes of a heading, and what is remembered of it.

    A heading is off if it is further from the belief than ``config.gate`` standard deviations (chi-square gating),
    disturbed if the device says so, the field's strength is not that of the start, or the local deviation has crept
    further than that. Neither locks the compass out:
    ``config.recover`` good ones over ``config.regain`` let it in again (beside a magnet, too, there is a place where
    the heading is right), and so does one that is steadily off for ``config.patience``, as a
    new north, for the odometry is the better judge of a turn, the compass of nothing but the field around it.
    """
    gate, disturbed = _field(gate, evidence, config)
    crept = not gate.disturbed and abs(evidence.local) > config.gate * config.local
    # The first heading stays, or there would be no north to come back to.
    if disturbed or crept or (evidence.taken_back and gate.anchored):
        return Verdict.LEFT_OUT, _off(gate, evidence, steady=False)
    if not gate.anchored:
        return Verdict.ANCHORED, replace(gate, anchored=True, disturbed=False, good=0)
    if abs(evidence.residual) <= config.gate * (evidence.variance + config.noise**2) ** 0.5:
        gate, enough = _good(gate, evidence, config) if gate.disturbed else (gate, True)
        if not enough:
            return Verdict.LEFT_OUT, replace(gate, rejected=gate.rejected + 1, steady_since=evidence.stamp)
        return Verdict.USED, replace(gate, disturbed=False, good=0, home_good=0)
    return _far(gate, evidence, config)


def _field(gate: Gate, evidence: Evidence, config: HeadingTrust) -> tuple[Gate, bool]:
    """The gate with the field learned, and whether the reading is disturbed."""
    if evidence.flagged:
        return gate, True
    if evidence.field is None:
        return gate, False
    if gate.fields >= REFERENCE:
        return gate, abs(evidence.field - gate.field) > config.field * gate.field
    count = gate.fields + 1
    return replace(gate, fields=count, field=gate.field + (evidence.field - gate.field) / count), False


def _good(gate: Gate, evidence: Evidence, config: HeadingTrust) -> tuple[Gate, bool]:
    """The gate after a good heading while disturbed, and whether there were enough that agree."""
    if not gate.good or abs(wrap_angle(evidence.residual - gate.good_residual)) > 2 * config.local:
        gate = replace(
            gate,
            good=0,
            good_since=evidence.stamp,
            good_from=evidence.place,
            good_residual=evidence.residual,
        )
    gate = replace(gate, good=gate.good + 1)
    (x, y, yaw), (x0, y0, yaw0) = evidence.place, gate.good_from
    far = math.hypot(x - x0, y - y0) + abs(wrap_angle(yaw - yaw0)) >= config.regain
    long = evidence.stamp - gate.good_since >= config.patience * SECOND
    return gate, gate.good >= config.recover and (far or long)


def _far(gate: Gate, evidence: Evidence, config: HeadingTrust) -> tuple[Verdict, Gate]:
    if gate.home is not None:
        north, variance = gate.home
        off = wrap_angle(evidence.residual + north - evidence.north[0])
        near = abs(off) <= config.gate * (evidence.yaw_variance + variance + config.local**2 + config.noise**2) ** 0.5
        gate = replace(gate, home_good=gate.home_good + 1 if near else 0)
        if gate.home_good >= config.recover:
            return Verdict.HOME, replace(gate, disturbed=False, good=0, home_good=0)
    steady = abs(wrap_angle(evidence.residual - gate.last)) <= config.local
    gate = _off(gate, evidence, steady=steady)
    if evidence.stamp - gate.steady_since < config.patience * SECOND:
        return Verdict.LEFT_OUT, gate
    home = gate.home or evidence.north
    return Verdict.ANCHORED, replace(gate, disturbed=False, good=0, home=home, home_good=0)


def _off(gate: Gate, evidence: Evidence, *, steady: bool) -> Gate:
    since = gate.steady_since if steady and gate.disturbed else evidence.stamp
    return replace(
        gate,
        disturbed=True,
        good=0,
        steady_since=since,
        last=evidence.residual if not steady else gate.last,
        rejected=gate.rejected + 1,
    )
