"""5.7 Computer: processor time of every module, and how slow a board may be, by ``placement.slowness``.

The whole daemon maps and drives on the virtual clock: ours follows the lap with its tracker; ``published`` with the
fuzzy rules at 5 Hz. Time counts from the first second after the truck was to be armed. A deadline of control is missed
by every fifth of a second in which the tracker did nothing that the gate drove by (a gate that stops, or was never
armed, misses all), one of mapping by every scan (10 Hz) whose result takes longer than a tenth of a second or that is
passed over. The factor at which 1 % is first missed is bisected to a tenth. Processor time is this computer's; factors
of boards are estimates.
"""

import contextlib
import functools
import math
import resource
from typing import Any

import numpy as np

from benchmarks import scoring
from benchmarks.navigation_parts import Options, Part
from benchmarks.navigation_parts.daemon import CONFIGS
from monstertruck_runtime.clock import SECOND, VirtualClock, run_virtual
from monstertruck_runtime.errors import RequestRefusedError
from monstertruck_runtime.slowness import BOARDS
from monstertruck_schemas import topics
from monstertruck_schemas.state import GateMode
from monstertruckd.config.load import load_config
from monstertruckd.tools.figures import new_figure, write_figure
from monstertruckd.tools.simulation.config import SimulatedTruckConfig, with_overlay
from monstertruckd.tools.simulation.operator import LocalOperator
from monstertruckd.tools.simulation.virtual_rig import VirtualRig

FACTORS = (1.0, 3.0, BOARDS["xu4"], 10.0, BOARDS["pi2"], 40.0)
QUICK_FACTORS = (1.0, 40.0)
RATIO, QUICK_RATIO = 1.1, 40.0
"""Between the factor that first misses deadlines and one that does not."""
SECONDS, QUICK_SECONDS = 20.0, 3.0
CONTROL, LIDAR = 0.2, 0.1
"""Periods, s."""
ALLOWED = 0.01
"""Share of deadlines that may be missed."""
TRACKERS: dict[str, dict[str, Any]] = {
    "ours": {"tracker": {"kind": "lqr"}},
    "published": {"tracker": {"kind": "fuzzy", "rules": "published", "rate": 5.0, "speed": 0.2, "steering": "counter"}},
}


def run(options: Options) -> Part:
    part = Part()
    factors, ratio, seconds = (
        (QUICK_FACTORS, QUICK_RATIO, QUICK_SECONDS) if options.quick else (FACTORS, RATIO, SECONDS)
    )
    rows: dict[str, list[dict[str, Any]]] = {}
    for name in TRACKERS:
        at = functools.cache(functools.partial(result_of, rows.setdefault(name, []), name, seconds))
        for factor in factors:
            for what in ("control", "mapping"):
                part.add(f"{name}.x{factor:g}.{what}_missed_share", at(factor)[what])
        for what in ("control", "mapping"):
            first = scoring.first_miss(lambda factor, at=at, what=what: at(factor)[what], factors, ALLOWED, ratio)
            if math.isinf(first):
                part.add(f"{name}.{what}_keeps_up_to", factors[-1])
            else:
                part.add(f"{name}.{what}_first_misses_at", first)
        modules(part, name, at(1.0))
        rows[name].sort(key=lambda row: row["factor"])
    part.goals["ours.x1.control_missed_share"] = part.goals["ours.x1.mapping_missed_share"] = ALLOWED
    part.add("ram_daemon_and_world_mb", resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024)
    draw(options, rows)
    return part


def modules(part: Part, name: str, row: dict[str, Any]) -> None:
    """Record the share of a core, and percentiles of a turn, of every module, without slowness."""
    for module, turns in sorted(row["turns"].items()):
        prefix = f"{name}.{module.replace(' ', '_')}"
        part.add(f"{prefix}.cpu_percent", 100 * sum(turns) / row["seconds"])
        for key, value in scoring.percentiles(1e3 * np.array(turns)).items():
            part.add(f"{prefix}.turn_{key}", value)


def result_of(rows: list[dict[str, Any]], name: str, seconds: float, factor: float) -> dict[str, Any]:
    """Return the run of a set-up at a factor, printed and added to its ``rows``."""
    row = drive(TRACKERS[name], factor, seconds)
    print(f"  {name} x{factor:.3g}: control {row['control']:.3f}, mapping {row['mapping']:.3f}", flush=True)
    rows.append(row)
    return row


def drive(overlay: dict[str, Any], factor: float, seconds: float) -> dict[str, Any]:
    """Return the shares of missed deadlines and the turns of every module while the truck drives."""
    config = load_config(CONFIGS / "slam.yaml", SimulatedTruckConfig)[0]
    common = {"recorder": None, "blackbox": None, "map": None, "placement": {"slowness": factor}}
    config = with_overlay(config, {**common, "tracker": None})
    config = with_overlay(config, overlay)
    acted: list[float] = []
    driving = False

    def gate(_topic: object, state: Any, *_: object) -> None:
        nonlocal driving
        driving = state.mode is GateMode.DRIVING

    async def main(clock: VirtualClock) -> dict[str, Any]:
        rig = VirtualRig(config, clock)
        rig.bus.tap(gate, [topics.GATE])
        rig.bus.tap(lambda *_: acted.append(clock.now() / SECOND) if driving else None, [topics.TRACKER])
        async with rig.running():
            await clock.sleep(3.0)
            with contextlib.suppress(RequestRefusedError):  # too slow to be armed: no deadline is kept
                await LocalOperator(rig.daemon, clock).arm()
            await clock.sleep(1.0)
            slow = rig.daemon.slow
            assert slow is not None
            slow.turns.clear()
            begin = clock.now() / SECOND
            await clock.sleep(seconds)
            end = clock.now() / SECOND
            return {"turns": {name: list(turns) for name, turns in slow.turns.items()}, "begin": begin, "end": end}

    row = run_virtual(main)
    begin, end = row["begin"], row["end"]
    steps = factor * np.array(row["turns"].get("worker slam", []))
    due = max(round((end - begin) / LIDAR), 1)
    return row | {
        "factor": factor, "seconds": end - begin, "control": scoring.missed(acted, begin, end, CONTROL),
        "mapping": min(max(1.0 - (steps <= LIDAR).sum() / due, 0.0), 1.0),
    }  # fmt: skip


def draw(options: Options, rows: dict[str, list[dict[str, Any]]]) -> None:
    figure = new_figure(12, 5)
    misses, cpu = figure.subplots(1, 2)
    for name, found in rows.items():
        for what, style in (("control", "-o"), ("mapping", "--s")):
            factors = [row["factor"] for row in found]
            misses.plot(factors, [100 * row[what] for row in found], style, label=f"{name}, {what}")
    misses.axhline(100 * ALLOWED, color="0.6")
    for board, factor in BOARDS.items():
        misses.axvline(factor, color="0.8")
        misses.text(factor, 50, f"{board} (estimate)", rotation=90, fontsize=8)
    misses.set_xscale("log")
    misses.set_xlabel("slowness")
    misses.set_ylabel("deadlines missed, %")
    misses.legend()
    row = rows["ours"][0]
    shares = sorted((100 * sum(turns) / row["seconds"], module) for module, turns in row["turns"].items())
    cpu.barh([module for _, module in shares], [share for share, _ in shares])
    cpu.set_xlabel("% of a core, ours, this computer")
    write_figure(figure, options.out / "computer.png")
