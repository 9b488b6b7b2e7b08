"""The study's table: measured values next to the ideal robot's and the paper's values."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from typing import Any

from monstertruck_kinematics.identification import MeasuredCircle, fit_circles, skid_model
from monstertruck_runtime.errors import InputError
from monstertruckd.tools.study import published
from monstertruckd.tools.study.analysis import Circle, StraightPasses, circle, line
from monstertruckd.tools.study.log import Run

Result = tuple[Run, Circle | StraightPasses]


def analyse(runs: Sequence[Run]) -> list[Result]:
    """Every run with its result.

    Raises:
        InputError: one of them has no result; names it, with the reason of ``analysis.circle`` or ``line``.
    """
    return [(run, _found(run)) for run in runs]


def _found(run: Run) -> Circle | StraightPasses:
    try:
        if run.straight:
            return line(run.times, run.poses, run.directions)
        return circle(run.times, run.poses)
    except InputError as error:
        raise InputError(f"{run.name}: {error}") from error


def as_values(results: Sequence[Result], radius: float, half_track: float) -> dict[str, Any]:
    """Everything as plain values.

    Args:
        results: results of ``analyse``.
        radius: radius of the wheels, nominal (m).
        half_track: m.
    """
    circles = [_circle(run, found, radius, half_track) for run, found in results if isinstance(found, Circle)]
    lines = [_line(run, found, radius) for run, found in results if isinstance(found, StraightPasses)]
    values: dict[str, Any] = {"circles": circles, "lines": lines, "slips_of_the_paper": list(published.SLIPS)}
    measured = [
        MeasuredCircle(run.name, run.left, run.right, found.radius, found.speed)
        for run, found in results
        if isinstance(found, Circle) and run.left + run.right
    ]
    if len({round(math.atan2(one.left, one.right), 9) for one in measured}) >= 2:
        fit = fit_circles(measured, skid_model("symmetric", radius, half_track))
        values["symmetric_model"] = {name: value for name, value, _ in fit.parameter_table()}
    return values


def _circle(run: Run, found: Circle, radius: float, half_track: float) -> dict[str, Any]:
    left, right = run.left * radius, run.right * radius
    speed, turn = (left + right) / 2, (right - left) / (2 * half_track)
    values = {
        "run": run.name,
        **asdict(found),
        "drift_speed": math.hypot(*found.drift),
        "ideal_speed": abs(speed),
        "ideal_radius": abs(speed / turn),
        "speed_deviation": found.speed / abs(speed) - 1.0 if speed else None,
        "radius_deviation": found.radius / abs(speed / turn) - 1.0 if speed else None,
    }
    if (row := published.nearest(run.left, run.right)) is not None:
        values["published"] = {
            "radius": row.measured.radius,
            "speed": row.measured.speed,
            "speed_deviation": row.speed_deviation / 100,
            "radius_deviation": row.radius_deviation / 100,
            "drift": row.drift,
            "drift_speed": row.drift_speed,
            "intercepts": row.intercepts,
            "slip": row.slip or None,
        }
    return values


def _line(run: Run, found: StraightPasses, radius: float) -> dict[str, Any]:
    ideal = abs(run.left) * radius
    return {
        "run": run.name,
        **asdict(found),
        "ideal_speed": ideal,
        "speed_deviation": found.speed / ideal - 1.0,
        "published": {
            "segment": 0.682,  # m
            "passes": 12,
            # Spread of the tracks of 12 passes, as a share of the segment.
            "spread": 0.1569,
            # Within one pass, share of the segment.
            "bend": 0.0002,
            # Relative deviation of the line's speed from 3.24 cm/s.
            "speed_deviation": 0.06,
        },
    }


HEADINGS = ("run", "quantity", "ideal", "measured", "deviation", "paper", "its deviation", "slip of the paper")


def rows(values: dict[str, Any]) -> Iterator[tuple[str, ...]]:
    """The table as text; lengths cm, speeds cm/s, drifts mm/s."""
    for one in values["circles"]:
        paper = one.get("published", {})
        yield (
            one["run"],
            "radius cm",
            _number(one["ideal_radius"], 100),
            _number(one["radius"], 100),
            _percent(one["radius_deviation"]),
            _number(paper.get("radius"), 100),
            _percent(paper.get("radius_deviation")),
            "",
        )
        yield (
            "",
            "speed cm/s",
            _number(one["ideal_speed"], 100),
            _number(one["speed"], 100),
            _percent(one["speed_deviation"]),
            _number(paper.get("speed"), 100),
            _percent(paper.get("speed_deviation")),
            paper.get("slip") or "",
        )
        drifts = paper.get("drift") or (None, None)
        for name, ours, theirs in zip("XY", one["drift"], drifts, strict=True):
            yield "", f"d{name}/dt mm/s", "0", _number(ours, 1000, 4), "", _number(theirs, 1000, 4), "", ""
        yield (
            "",
            "drift mm/s",
            "0",
            _number(one["drift_speed"], 1000, 4),
            "",
            _number(paper.get("drift_speed"), 1000),
            "",
            "",
        )
        places = paper.get("intercepts") or (None, None)
        for name, ours, theirs in zip("XY", one["centre"], places, strict=True):
            yield "", f"{name} at 0, m", "", _number(ours), "", _number(theirs), "", ""
    for one in values["lines"]:
        paper = one["published"]
        yield one["run"], "spread", "0", _percent(one["spread"]), "", _percent(paper["spread"]), "", ""
        yield "", "bend in a pass", "0", _percent(one["bend"]), "", _percent(paper["bend"]), "", ""
        speeds = _number(one["ideal_speed"], 100), _number(one["speed"], 100), _percent(one["speed_deviation"])
        yield "", "speed cm/s", *speeds, "", _percent(paper["speed_deviation"]), published.SLIPS[2]
        yield "", "turn at a reversal deg", "0", f"{math.degrees(one['reversal_turn']):.2f}", "", "", "", ""


def _number(value: float | None, scale: float = 1.0, digits: int = 3) -> str:
    return "" if value is None else f"{scale * value:.{digits}f}"


def _percent(value: float | None) -> str:
    return "" if value is None else f"{100 * value:.2f} %"
