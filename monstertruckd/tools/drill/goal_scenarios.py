"""What a drill has to show, and what it showed as a line of a table."""

from collections.abc import Iterator
from typing import Final

from monstertruckd.tools.drill.scenario import AT_REST, Expect, Reaction, Scenario

STOP_AFTER_DETECTION: Final = 0.05
"""Seconds from a detected loss to the stop bytes on the wire."""
STOP_AFTER_SAMPLE: Final = 0.3
"""Seconds from the last good sample to the stop bytes."""
STANDSTILL: Final = 0.3
"""Seconds from the stop bytes, or the fault that forestalled them, to standstill."""
STANDSTILL_AGAIN: Final = 1.2
"""Seconds from the moment the drive controller can be reached again to standstill."""
STANDSTILL_BY_LINE: Final = 0.6
"""Seconds from the loss of the drive controller to standstill by the deadman line."""
GOALS: Final = {
    "stop_after_detection_s": STOP_AFTER_DETECTION,
    "stop_after_sample_s": STOP_AFTER_SAMPLE,
    "standstill_after_stop_s": STANDSTILL,
    "standstill_after_return_s": STANDSTILL_AGAIN,
    "standstill_by_line_s": STANDSTILL_BY_LINE,
    "back_after_replug_s": 2.0,
}


def shortcomings(scenario: Scenario, reaction: Reaction) -> list[str]:
    """Everything about a reaction that should have been otherwise; empty = all goals met."""
    return [*_reaction(scenario, reaction), *_account(scenario, reaction), *_afterwards(scenario, reaction)]


def _reaction(scenario: Scenario, got: Reaction) -> Iterator[str]:
    if got.collided:
        yield "ran into something"
    match scenario.expect:
        case Expect.STOP:
            yield from _stops_in_time(got)
        case Expect.STOP_AHEAD if got.standstill_after_s is None:
            yield "did not stop"
        case Expect.STOP_AGAIN:
            yield from _late(got.standstill_after_s, got.healed_after_s + STANDSTILL_AGAIN, "standstill")
        case Expect.STOP_BY_LINE:
            yield from _late(got.standstill_after_s, STANDSTILL_BY_LINE, "standstill")
        case Expect.ENDURE if got.reason is not None:
            limit = STANDSTILL_AGAIN if scenario.device == "drive" else STOP_AFTER_SAMPLE + STANDSTILL
            yield from _late(got.standstill_after_s, limit, "standstill")
        case Expect.GO_ON | Expect.SLOW_DOWN if got.reason is not None or got.standstill_after_s is not None:
            yield f"stopped: {got.reason}"
        case Expect.REFUSE if got.top_speed > AT_REST:
            yield f"moved at {got.top_speed:.2f} m/s"
        case Expect.EXIT:
            yield from _stops_in_time(got)
            if not got.exited:
                yield "the daemon goes on"


def _stops_in_time(got: Reaction) -> Iterator[str]:
    if got.stop_bytes_after_s is None or got.detected_after_s is None:
        yield "no stop on the wire"
        return
    yield from _late(got.stop_bytes_after_s, got.detected_after_s + STOP_AFTER_DETECTION, "stop bytes")
    if got.stop_bytes_after_sample_s is not None:
        yield from _late(got.stop_bytes_after_sample_s, STOP_AFTER_SAMPLE, "stop bytes, from the last sample,")
    began = max(got.stop_bytes_after_s, got.detected_after_s)
    yield from _late(got.standstill_after_s, began + STANDSTILL, "standstill")


def _late(seconds: float | None, limit: float, what: str) -> Iterator[str]:
    if seconds is None or seconds > limit:
        yield f"{what} after {seconds} s: at most {limit:.3f} s"


def _account(scenario: Scenario, got: Reaction) -> Iterator[str]:
    """Reasons and services told."""
    places = [got.seen.index(reason) if reason in got.seen else -1 for reason in scenario.seen]
    if -1 in places or places != sorted(places):
        yield f"told {', '.join(got.seen)}: expected {', '.join(scenario.seen)}"
    stopping = scenario.expect in (Expect.STOP, Expect.STOP_AHEAD, Expect.STOP_AGAIN, Expect.STOP_BY_LINE)
    if stopping and scenario.seen and got.reason is not scenario.seen[-1]:
        yield f"stopped for {got.reason}: expected {scenario.seen[-1]}"
    for service, reason in scenario.down.items():
        if reason not in got.down.get(service, ()):
            yield f"{service} down for {', '.join(got.down.get(service, ()))}: expected {reason}"
    allowed = {*scenario.down, *((scenario.device,) if scenario.device else ())}
    if scenario.expect is not Expect.EXIT and (others := got.down.keys() - allowed):
        yield f"{', '.join(sorted(others))} down too"


def _afterwards(scenario: Scenario, got: Reaction) -> Iterator[str]:
    if scenario.expect is Expect.EXIT:
        return
    if scenario.recovers and got.recovered_after_s is None:
        yield f"not back within {scenario.patience:g} s"
    if scenario.recovers and not got.drove_again:
        yield "cannot be driven again"
    if scenario.expect is not Expect.ENDURE and got.moved_by_itself is not scenario.resumes:
        yield "moved by itself" if got.moved_by_itself else "did not go on by itself"


COLUMNS: Final = ("fault", "detected", "stop bytes", "standstill", "metres", "reason", "back")


def cells(scenario: Scenario, reaction: Reaction) -> tuple[str, ...]:
    """One row of the table: seconds from the fault (``back``: from its end), metres."""
    told: list[str] = [*scenario.seen[-1:]] or sorted(set(scenario.down.values())) or [reaction.reason or "-"]
    return (
        reaction.fault,
        _seconds(reaction.detected_after_s),
        _seconds(reaction.stop_bytes_after_s),
        _seconds(reaction.standstill_after_s),
        f"{reaction.metres:.3f}",
        ", ".join(told),
        _seconds(reaction.recovered_after_s),
    )


def _seconds(value: float | None) -> str:
    return "-" if value is None else f"{value:.3f}"
