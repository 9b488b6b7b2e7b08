"""Description of why the truck stopped, for gate, command line and stations."""

from collections.abc import Iterator, Sequence

from monstertruck_runtime.clock import SECOND
from monstertruck_schemas.event import Cause, Measurement, Stop


def causes_text(causes: Sequence[Cause], now: int) -> str:
    """Describe all causes in one line, each followed by its own causes.

    Args:
        causes: as in ``Stop``.
        now: time up to which durations are measured, ns.
    """
    return "; ".join(
        ", because ".join(cause_text(cause, now) for cause in chain(causes, head)) for head in heads(causes)
    )


def stop_lines(stop: Stop, now: int) -> list[str]:
    """Describe the stop in a few lines: the stop and its time, then the causes, each indented below its effect.

    Args:
        stop: latest message with its number.
        now: the robot's time, ns, e.g. the stamp of its latest gate state.
    """
    how = "quick stop" if stop.quick else "stop"
    speed = "" if stop.speed is None else f" at {abs(stop.speed):.2f} m/s"
    driver = "" if stop.holder is None else f", driver {stop.holder}"
    lines = [f"{how}{speed} {duration_text((now - stop.stamp) / SECOND)} ago{driver}"]
    for head in heads(stop.causes):
        for depth, cause in enumerate(chain(stop.causes, head)):
            lines.append("  " * depth + ("because " if depth else "") + cause_text(cause, stop.stamp))
    if stop.black_box is not None:
        lines.append(f"black box {stop.black_box}")
    return lines


def heads(causes: Sequence[Cause]) -> list[Cause]:
    """Return the causes that directly tripped the gate: those that caused no other cause."""
    deeper = {cause.because for cause in causes}
    return [cause for index, cause in enumerate(causes) if index not in deeper]


def chain(causes: Sequence[Cause], head: Cause) -> Iterator[Cause]:
    """``head`` and its causes, link by link; an invalid or repeated index ends the chain."""
    left = len(causes)
    cause = head
    while True:
        yield cause
        left -= 1
        if cause.because is None or not cause.because < len(causes) or left <= 0:
            return
        cause = causes[cause.because]


def cause_text(cause: Cause, now: int) -> str:
    """Describe one cause, for example ``no fresh lidar scan (for 10 ms, age 260 ms, limit 250 ms)``."""
    lasted = (now - cause.since) / SECOND
    notes = [f"for {duration_text(lasted)}"] if lasted >= 1e-3 else []
    notes += [measurement_text(measurement) for measurement in cause.measurements]
    return cause.text + (f" ({', '.join(notes)})" if notes else "")


def measurement_text(measurement: Measurement) -> str:
    """Describe one measurement with its limit and, unless it is an age itself, its age."""
    text = f"{measurement.name} {_quantity_text(measurement.value, measurement.unit)}"
    if measurement.limit is not None:
        text += f", limit {_quantity_text(measurement.limit, measurement.unit)}"
    return text if measurement.age is None else f"{text}, {duration_text(measurement.age)} old"


def duration_text(seconds: float) -> str:
    """Format a duration: ms below a second, then s, then minutes."""
    if seconds < 1.0:
        return f"{seconds * 1e3:.0f} ms"
    return f"{seconds:.1f} s" if seconds < 100 else f"{seconds / 60:.0f} min"


def _quantity_text(value: float | None, unit: str) -> str:
    if value is None:
        return "unknown"
    return duration_text(value) if unit == "s" else f"{value:.3g} {unit}".rstrip()
