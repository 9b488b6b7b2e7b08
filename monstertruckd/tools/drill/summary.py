"""Results of a fault-family drill, by family."""

from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np

from monstertruck_schemas.reasons import Reason
from monstertruckd.tools.drill.campaign import TrialOutcome
from monstertruckd.tools.drill.unrevealed import explained


@dataclass(frozen=True, slots=True)
class FamilySummary:
    """Trials of one family."""

    family: str
    trials: int
    noticed: int
    """Trials with a reason, counted only for the first fault of a trial."""
    reason: Reason | None
    """Reason that occurred most often."""
    reason_p50_s: float | None
    reason_max_s: float | None
    """Maximum time from the fault to the reason (s); ``reason_p50_s`` is the median."""
    unsafe: int
    stuck: int


def by_family(outcomes: Iterable[TrialOutcome]) -> list[FamilySummary]:
    """Return one summary for each tested family, by name."""
    found: dict[str, list[TrialOutcome]] = defaultdict(list)
    for outcome in outcomes:
        for family in dict.fromkeys(outcome.families):
            found[family].append(outcome)
    return [_summary(family, tried) for family, tried in sorted(found.items())]


def _summary(family: str, outcomes: list[TrialOutcome]) -> FamilySummary:
    own = [
        o for o in outcomes if o.families[0] == family and o.reason is not None
    ]  # the reason may belong to the other fault of a pair
    times = [o.reason_s for o in own if o.reason_s is not None]
    reasons = Counter(o.reason for o in own).most_common(1)
    return FamilySummary(
        family,
        len(outcomes),
        len(own),
        reasons[0][0] if reasons else None,
        float(np.median(times)) if times else None,
        max(times, default=None),
        sum(o.unsafe for o in outcomes),
        sum(bool(o.stuck) for o in outcomes),
    )


def without_reason(summaries: Iterable[FamilySummary]) -> Iterator[str]:
    """Yield lines on the families without a reason: known ones with their limit, the others by name."""
    by_row, others = explained(summary.family for summary in summaries if not summary.noticed)
    for row, families in by_row.items():
        yield f"nothing reveals {', '.join(families)}: {row.why}; limit: {row.limit}"
    if others:
        yield f"no reason within the trial: {', '.join(others)}"


def troubles(outcomes: Iterable[TrialOutcome]) -> Iterator[str]:
    """Yield one line for each unsafe event and each robot that did not recover."""
    for outcome in outcomes:
        where = f"trial {outcome.number}, {'reverse' if outcome.reverse else 'forwards'}, {' + '.join(outcome.faults)}"
        for violation in outcome.violations:
            yield f"{where}: after {violation.seconds:.2f} s {violation.rule}: {violation.text}"
        if outcome.stuck:
            yield f"{where}: not recovered: {', '.join(outcome.stuck)}"
