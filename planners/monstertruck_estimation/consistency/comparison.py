"""Pairwise comparison of motion measures, relative to their stated errors, to find the odd one out.

Every measure states its maximum error while it works: a share of the distance or turn, and a constant.
Two measures disagree if they differ by more than the sum of both errors and the effect of a tolerated delay.
"""

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from enum import StrEnum
from itertools import combinations
from typing import Final, NamedTuple

from monstertruck_estimation.consistency.config import ConsistencyConfig
from monstertruck_kinematics.se2 import Pose2
from monstertruck_runtime.clock import SECOND

MOST_DEVIATIONS: Final = 2.0
"""Maximum errors of a working measure, in standard deviations."""


class Measure(StrEnum):
    """Independent measures of the robot's motion."""

    WHEELS = "wheels"
    SCANS = "scans"
    GYRO = "gyro"
    COMPASS = "compass"
    ENCODERS = "encoders"
    STAND = "stand"


class Quantity(StrEnum):
    """Compared quantities."""

    WAY = "way"
    TURN = "turn"


@dataclass(frozen=True, slots=True)
class Errors:
    """Maximum errors of a working measure."""

    way: tuple[float, float] | None
    """Distance error: share of the greater distance, and constant (m); None if the measure gives no distance."""
    turn: tuple[float, float]
    """Turn error: share of the greater turn, and constant (rad)."""
    less: float | None = None
    """Share of the distance that applies where this measure shows the smaller one; None for the same share."""
    aside: float = 0.0
    """Sideways error, as a share of the distance."""
    bend: float = 0.0
    """Turn error per metre (rad)."""
    drift: float = 0.0
    """Turn error per second (rad)."""


def errors_of(config: ConsistencyConfig) -> dict[Measure, Errors]:
    """Return the errors that each measure states.

    Wheels slip, and their steering angles are the commanded ones. Scan odometry errs by the noise of ranges. A
    gyroscope's bias changes by less than 0.01 rad/s between two rests. A compass deviates near iron by some tenths.
    Cameras over a table locate a robot's tag within some millimetres; exposures and clocks of two computers differ.
    """
    slip = config.slip
    return {
        Measure.WHEELS: Errors(way=(slip, 0.02), turn=(slip, 0.05), less=config.slide, aside=0.12, bend=0.15),
        Measure.SCANS: Errors(way=(0.03, 0.04), turn=(0.03, 0.04), aside=0.03),
        Measure.GYRO: Errors(way=None, turn=(0.05, 0.02), drift=0.01),
        Measure.COMPASS: Errors(way=None, turn=(0.1, 0.35)),
        Measure.STAND: Errors(way=(0.02, 0.03), turn=(0.02, 0.05), aside=0.02),
        Measure.ENCODERS: Errors(way=(0.1, 0.03), turn=(0.1, 0.05), aside=0.12, bend=0.1),
    }


class Motions(NamedTuple):
    """Motion between two instants by all measures."""

    since: int
    """Start of the motion (ns)."""
    stamp: int
    """End of the motion (ns)."""
    motions: Mapping[Measure, Pose2]
    """Base at ``stamp`` in base at ``since``; only the yaw is valid for measures of turns alone."""
    slack: tuple[float, float]
    """Difference that tolerated delays and stamp errors explain (m, rad)."""


class Disagreement(NamedTuple):
    """Two measures that differ by more than their errors explain."""

    quantity: Quantity
    one: Measure
    other: Measure
    by_one: float
    """Distance (m) or turn (rad) by ``one``."""
    by_other: float
    difference: float
    """Difference between both motions (m or rad)."""
    limit: float
    """Difference that their errors and the tolerated delay explain (m or rad)."""

    @property
    def text(self) -> str:
        """Description in words."""
        unit, word = ("m", "moved") if self.quantity is Quantity.WAY else ("rad", "turned")
        form = ".2f" if self.quantity is Quantity.WAY else "+.2f"
        return (
            f"{self.one}: the robot {word} {self.by_one:{form}} {unit}; {self.other}: "
            f"{self.by_other:{form}} {unit}; difference {self.difference:.2f} {unit}, limit "
            f"{self.limit:.2f} {unit}"
        )


def turn_difference(
    motions: Motions, one: Measure, other: Measure, errors: Mapping[Measure, Errors]
) -> tuple[float, float]:
    """Return the difference of two turns, and the part that errors and delay explain (rad)."""
    greatest = max(abs(motions.motions[measure][2]) for measure in (one, other))
    seconds, way = (motions.stamp - motions.since) / SECOND, _way(motions)
    limit = math.fsum(
        error.turn[0] * greatest + error.turn[1] + error.bend * way + error.drift * seconds
        for error in (errors[one], errors[other])
    )
    return abs(motions.motions[one][2] - motions.motions[other][2]), limit + motions.slack[1]


def way_difference(
    motions: Motions, one: Measure, other: Measure, errors: Mapping[Measure, Errors]
) -> tuple[float, float, float]:
    """Return the difference of two measures and its limit in the less likely direction, and the whole difference (m).

    Errors and delay explain a difference up to the limit. Along the path the difference is one of lengths, across it
    one of directions.
    """
    (x1, y1, _), (x2, y2, _) = motions.motions[one], motions.motions[other]
    longest, mean = max(math.hypot(x1, y1), math.hypot(x2, y2)), (x1 + x2, y1 + y2)
    norm = math.hypot(*mean)
    if norm < 1e-6:
        mean = (x1 - x2, y1 - y2)
        norm = math.hypot(*mean) or 1.0
    ux, uy = mean[0] / norm, mean[1] / norm
    dx, dy = x1 - x2, y1 - y2
    along, across = abs(dx * ux + dy * uy), abs(dy * ux - dx * uy)
    _, turn_limit = turn_difference(motions, one, other, errors)
    lengthwise = way_limit(motions, one, other, errors)
    constant = math.fsum(error.way[1] for error in (errors[one], errors[other]) if error.way is not None)
    sideways = errors[one].aside + errors[other].aside + turn_limit / 2
    limits = lengthwise, constant + motions.slack[0] + sideways * longest
    if along / limits[0] >= across / limits[1]:
        return along, limits[0], math.hypot(dx, dy)
    return across, limits[1], math.hypot(dx, dy)


def way_limit(motions: Motions, one: Measure, other: Measure, errors: Mapping[Measure, Errors]) -> float:
    """Return the difference of lengths that errors and delay explain (m)."""
    lengths = {measure: math.hypot(*motions.motions[measure][:2]) for measure in (one, other)}
    longest, limit = max(lengths.values()), motions.slack[0]
    for measure, length in lengths.items():
        error = errors[measure]
        if error.way is not None:
            share = error.less if error.less is not None and length < longest else error.way[0]
            limit += error.way[1] + share * longest
    return limit


def differences(
    motions: Motions, errors: Mapping[Measure, Errors]
) -> tuple[list[Disagreement], dict[Quantity, set[frozenset[Measure]]]]:
    """Return the pairs that disagree, and by quantity those that agree."""
    found: list[Disagreement] = []
    agreeing: dict[Quantity, set[frozenset[Measure]]] = {Quantity.WAY: set(), Quantity.TURN: set()}
    for one, other in combinations(motions.motions, 2):
        off, limit = turn_difference(motions, one, other, errors)
        turns = motions.motions[one][2], motions.motions[other][2]
        if off > limit:
            found.append(Disagreement(Quantity.TURN, one, other, *turns, off, limit))
        else:
            agreeing[Quantity.TURN].add(frozenset((one, other)))
        if errors[one].way is None or errors[other].way is None:
            continue
        way, limit, apart = way_difference(motions, one, other, errors)
        lengths = math.hypot(*motions.motions[one][:2]), math.hypot(*motions.motions[other][:2])
        if way > limit:
            found.append(Disagreement(Quantity.WAY, one, other, *lengths, apart, limit))
        else:
            agreeing[Quantity.WAY].add(frozenset((one, other)))
    return found, agreeing


def suspects(
    found: Iterable[Disagreement], agreeing: Mapping[Quantity, Iterable[frozenset[Measure]]]
) -> dict[Measure, Disagreement]:
    """Return the measures that may be wrong, each with its largest difference.

    A measure that agrees with a second one is not suspected. Among the rest, suspects by turn narrow down those by
    distance.
    """
    found = list(found)
    by_quantity: dict[Quantity, dict[Measure, Disagreement]] = {}
    for quantity in Quantity:
        partnered = set().union(*agreeing[quantity])
        rows = [row for row in found if row.quantity is quantity]
        doubtful = {measure for row in rows for measure in (row.one, row.other)} - partnered
        if Measure.COMPASS in doubtful and len(doubtful) > 1:
            # Iron nearby deflects a needle by more than its stated error: a compass alone casts no doubt on others.
            rows = [row for row in rows if Measure.COMPASS not in (row.one, row.other)]
            doubtful &= {measure for row in rows for measure in (row.one, row.other)}
        by_quantity[quantity] = {
            measure: max(
                (row for row in rows if measure in (row.one, row.other)), key=lambda row: row.difference / row.limit
            )
            for measure in doubtful
        }
    ways, turns = by_quantity[Quantity.WAY], by_quantity[Quantity.TURN]
    if len(ways) > 1 and len(turns) == 1 and (named := ways.keys() & turns.keys()):
        return {measure: ways[measure] for measure in named}
    return turns | ways


def _way(motions: Motions) -> float:
    return max((math.hypot(x, y) for x, y, _ in motions.motions.values()), default=0.0)
