"""Conditions of missions: the facts about the robot that they require, and their evaluation."""

from dataclasses import dataclass
from typing import Final

from monstertruck_schemas.mission import Condition


@dataclass(frozen=True, slots=True)
class Facts:
    """Facts that conditions refer to."""

    charge: float | None = None
    """Charge of the battery (%); None if unknown."""
    elapsed: float = 0.0
    """Time since the mission was started or resumed (s)."""
    points: frozenset[str] = frozenset()
    """Names of the known points of interest."""
    tags: int = 0
    """Number of known tags."""
    obstacle: float = 0.0
    """Time for which an obstacle has stopped the robot (s)."""
    zones: frozenset[str] = frozenset()
    """Names of the zones overlapped by the footprint."""
    minute: int | None = None
    """Local time of day (minutes since midnight); None if unknown."""


UNKNOWN: Final = Facts()
"""Facts about a robot without any information."""


def holds(condition: Condition, facts: Facts) -> bool:
    """Return whether all keys of a condition hold."""
    of, charge = condition, facts.charge
    return (
        (of.battery_below is None or (charge is not None and charge < of.battery_below))
        and (of.battery_above is None or (charge is not None and charge > of.battery_above))
        and (of.after is None or facts.elapsed >= of.after)
        and (of.point is None or of.point in facts.points)
        and (of.tags is None or facts.tags >= of.tags)
        and (of.obstacle is None or facts.obstacle >= of.obstacle)
        and (of.zone is None or of.zone in facts.zones)
        and (of.time is None or (facts.minute is not None and _within(of.time, facts.minute)))
        and (of.any_of is None or any(holds(one, facts) for one in of.any_of))
        and (of.unless is None or not holds(of.unless, facts))
    )


def _within(interval: str, minute: int) -> bool:
    """Return whether a minute of the day lies in an interval such as 22:00-06:30, its end excluded."""
    begin, end = (60 * int(at[:2]) + int(at[3:]) for at in interval.split("-"))
    return begin <= minute < end if begin <= end else not end <= minute < begin


def in_words(condition: Condition) -> str:
    """Describe a condition in one line."""
    of, words = condition, []
    if of.battery_below is not None:
        words.append(f"battery below {of.battery_below:g} %")
    if of.battery_above is not None:
        words.append(f"battery above {of.battery_above:g} %")
    if of.after is not None:
        words.append(f"after {of.after:g} s")
    if of.point is not None:
        words.append(f"point {of.point} known")
    if of.tags is not None:
        words.append(f"{of.tags} tags known")
    if of.obstacle is not None:
        words.append(f"stopped by an obstacle for {of.obstacle:g} s")
    if of.zone is not None:
        words.append(f"in zone {of.zone}")
    if of.time is not None:
        words.append(f"time of day {of.time}")
    if of.any_of is not None:
        words.append(f"any of ({'; '.join(map(in_words, of.any_of))})")
    if of.unless is not None:
        words.append(f"not ({in_words(of.unless)})")
    return " and ".join(words)
