"""Wizards against hidden truth: 20 trucks, all values of each off, calibrated in the order of docs/calibration.md.

    python -m benchmarks.calibration [--seeds 20] [--jobs 1] [--light 200] [--engine mujoco]
    python -m benchmarks.calibration --only camera --light 200
    python -m benchmarks.calibration --part swapped|interruptions|square|alone [--count 20]

Every session runs the whole daemon on a virtual clock: real drivers, emulated devices, the safety gate; the operator
has a tape, a string and a meter with errors of their own. Judged is whether the true value lies in the stated interval,
and, against the truck's own linkage, the curvature that the calibrated truck believes, to its full lock.
With ``--engine mujoco`` trucks and the robots of ``alone`` are rigid bodies on springs and tyres; true is then how they
move in their world, driven by hand without noise (``tests/calibration_rigid.py``).
Before that the fits of every wizard are judged alone on drawn measurements, ``--light``
each: how often the truth lies inside, how wide the intervals are. ``--seeds 0`` leaves it at these, ``--only WIZARD``
at those of one.

``--part swapped``: a swapped cable or a wrong sign, drawn for every wizard, that it has to name in every case.
``--part interruptions``: Ctrl-C, a cable, the emergency stop, a low battery, a lost lease, and kill -9 of wizard and
daemon at random instants: the old file is intact, the truck neutral, and the wizard runs again (half an hour).
``--part alone``: the wizards of odometry, lidar, inertial unit, slip, stabiliser, camera and sonars, each alone.
``--part square``: closing error of dead reckoning after a square of 10 m, before and after ``calibrate all``.
"""

import argparse
import json
import logging
import math
import sys
from collections import defaultdict
from collections.abc import Callable, Iterable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from time import process_time
from typing import Any

import numpy as np

from benchmarks import ROOT
from benchmarks.calibration_parts.alone import alone
from benchmarks.calibration_parts.interruptions import interruptions
from benchmarks.calibration_parts.square import square
from monstertruck_runtime.errors import TruckError
from monstertruckd.config.calibration import CalibrationStore, with_values
from monstertruckd.config.load import load_config
from monstertruckd.tools.calibrate.battery import BatteryWizard
from monstertruckd.tools.calibrate.compass import CompassWizard
from monstertruckd.tools.calibrate.drive import DriveWizard
from monstertruckd.tools.calibrate.steering import SteeringWizard
from monstertruckd.tools.simulation.config import SimulatedTruckConfig, with_overlay
from tests.calibration_kit import Verdict, curvature_errors, hidden, run_session, verdicts
from tests.calibration_light import HALF_WIDTHS, LIGHT, coverage
from tests.calibration_wrong import WRONG, noticed

OUTPUT = ROOT / "runs" / "benchmarks" / "calibration.json"
GOAL = 0.9
CURVATURE = 0.02
"""Greatest error of the curvature, as a share."""
COVERAGE = (0.90, 0.99)
"""Bounds of the coverage by all intervals of a wizard."""
EMPTIER = (0.15,)
"""Charge of the second pack that the battery wizard sees."""


@dataclass(frozen=True)
class Truck:
    """One calibrated truck."""

    seed: int
    verdicts: list[Verdict]
    minutes: dict[str, float]
    """By wizard, on the truck's clock."""
    cpu_s: float
    curvature_errors: dict[str, float]
    """By mode and side, see ``curvature_errors``."""


def calibrate(seed: int, engine: str) -> Truck:
    """Run the whole procedure on one truck, in the world of an engine."""
    logging.disable(logging.CRITICAL)
    began = process_time()
    rng = np.random.default_rng([seed, 4])
    found: list[Verdict] = []
    minutes: dict[str, float] = defaultdict(float)
    yard = load_config(ROOT / "configs" / "yard.yaml", SimulatedTruckConfig)[0]
    base = with_overlay(yard, {"sim": {"world": {"engine": engine}}})
    with TemporaryDirectory(prefix="monstertruck-") as folder:
        quiet = base.model_copy(update={"recorder": None, "state_directory": Path(folder)})
        truck = hidden(quiet, rng, seed)
        for step in (
            BatteryWizard(),
            DriveWizard(sign_only=True),
            SteeringWizard(rough=True),
            CompassWizard(),
            DriveWizard(),
            SteeringWizard(),
        ):
            try:
                session = run_session(truck, step, rng, charges=EMPTIER if step.name == "battery" else ())
            except TruckError as error:
                print(f"truck {seed}: {step.name}: {error}", flush=True)
                found.append(Verdict(f"{step.name}.finished", False, None, None, True))
                continue
            found.append(Verdict(f"{step.name}.finished", True, None, None, True))
            rough = "rough." if session.result.partial else ""
            minutes[rough + step.name] += session.seconds / 60
            found += [Verdict(rough + v.name, v.value, v.low, v.high, v.truth) for v in verdicts(session.result, truck)]
        current = CalibrationStore(truck.calibration_folder, truck.robot).current()
        known = () if current is None else current.results.values()
        curvatures = curvature_errors(with_values(truck, known, "calibration"))
    return Truck(seed, found, dict(minutes), process_time() - began, curvatures)


def figures(trucks: Iterable[Truck]) -> dict[str, dict[str, float]]:
    """Return by estimate: trucks, share with the truth inside, median half-width, error over half-width (RMS)."""
    rows: dict[str, list[Verdict]] = defaultdict(list)
    for truck in trucks:
        for verdict in truck.verdicts:
            rows[verdict.name].append(verdict)
    out = {}
    for name, found in rows.items():
        ends = [(v.value, v.truth, (v.high - v.low) / 2) for v in found if v.low is not None and v.high is not None]
        out[name] = {"trucks": len(found), "inside": sum(v.holds for v in found) / len(found)}
        if ends:
            value, truth, half = np.array(ends, dtype=float).T
            out[name] |= {
                "half_width": float(np.median(half)),
                "error_rms": float(np.sqrt(np.mean((value - truth) ** 2))),
            }
    return out


def light(fits: int, wizards: Iterable[str]) -> tuple[dict[str, Any], bool]:
    """Fit drawn measurements: coverage by wizard, half-widths by estimate, and whether both meet the goals."""
    inside, halves, fine = {}, {}, True
    for wizard in wizards:
        found = coverage(wizard, fits)
        inside[wizard] = round(float(np.mean([share for share, _ in found.values()])), 4)
        fine &= COVERAGE[0] <= inside[wizard] <= COVERAGE[1]
        for name, (share, half) in found.items():
            print(f"| {name} | {share:.3f} | {half:.4g} |", flush=True)
            halves[name] = round(half, 5)
            fine &= half <= HALF_WIDTHS.get(name, math.inf)
    return {"fits": fits, "coverage": inside, "half_widths": halves}, fine


def swapped(count: int) -> tuple[dict[str, Any], dict[str, Any], bool]:
    """Return the share of wrong parts that every wizard names, the goals, and whether they are met."""
    found = {wizard: noticed(wizard, count) for wizard in WRONG}
    for wizard, named in found.items():
        print(f"{wizard}: {named} of {count} named", flush=True)
    return {"count": count, "named": found}, {"named": count}, all(named == count for named in found.values())


PARTS: dict[str, Callable[[int], tuple[dict[str, Any], dict[str, Any], bool]]] = {
    "swapped": swapped,
    "interruptions": interruptions,
    "square": square,
    "alone": alone,
}
"""Besides the trucks."""


def main() -> int:
    """Calibrate; 0: estimates are right in 90 % of the trucks, curvatures within 2 %, and the fits meet the goals."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument(
        "--engine", choices=("plane", "mujoco"), default="plane", help="of the world of trucks and `alone`"
    )
    parser.add_argument("--light", type=int, default=200)
    parser.add_argument("--only", choices=tuple(LIGHT), help="this wizard's light fits alone")
    parser.add_argument("--part", choices=("trucks", *PARTS), default="trucks")
    parser.add_argument("--count", type=int, default=20, help="of faults or interruptions of each kind")
    arguments = parser.parse_args()
    parts = PARTS | {"alone": partial(alone, engine=arguments.engine)}
    if arguments.part in parts:
        found, goals, met = parts[arguments.part](arguments.count)
        print(json.dumps({"bench": f"calibration.{arguments.part}", "figures": found, "goals": goals, "met": met}))
        return 0 if met else 1
    by_light: dict[str, Any] = {}
    fine = True
    if arguments.light:
        by_light, fine = light(arguments.light, LIGHT if arguments.only is None else (arguments.only,))
    light_goals = {"coverage": COVERAGE, "half_widths": HALF_WIDTHS}
    if not arguments.seeds or arguments.only is not None:
        print(json.dumps({"bench": "calibration", "figures": by_light, "goals": light_goals, "met": fine}))
        return 0 if fine else 1
    trucks = []
    with ProcessPoolExecutor(arguments.jobs) as pool:
        for truck in pool.map(partial(calibrate, engine=arguments.engine), range(arguments.seeds)):
            trucks.append(truck)
            missed = [v.name for v in truck.verdicts if not v.holds]
            print(f"truck {truck.seed}: {len(truck.verdicts)} estimates, outside: {missed or 'none'}", flush=True)
    table = figures(trucks)
    print("| estimate | trucks | inside | half-width | rms error |\n|---|---:|---:|---:|---:|")
    for name, row in table.items():
        half, error = (f"{row[key]:.4g}" if key in row else "" for key in ("half_width", "error_rms"))
        print(f"| {name} | {row['trucks']} | {row['inside']:.0%} | {half} | {error} |")
    OUTPUT.parent.mkdir(parents=True, exist_ok=True)
    OUTPUT.write_text(json.dumps([asdict(truck) for truck in trucks], indent=1), encoding="utf-8")
    worst = min(table.values(), key=lambda row: row["inside"])["inside"]
    modes = {mode: max(truck.curvature_errors[mode] for truck in trucks) for mode in trucks[0].curvature_errors}
    sums: dict[str, Any] = {
        "light": by_light,
        "trucks": len(trucks),
        "estimates": sum(len(truck.verdicts) for truck in trucks),
        "inside": sum(v.holds for truck in trucks for v in truck.verdicts) / sum(len(t.verdicts) for t in trucks),
        "worst_estimate_inside": worst,
        "inside_by_estimate": {name: row["inside"] for name, row in table.items()},
        "worst_curvature_error": max(modes.values()),
        "curvature_error_by_mode": {mode: round(error, 4) for mode, error in modes.items()},
        "minutes": {
            name: round(float(np.mean([t.minutes.get(name, 0.0) for t in trucks])), 1) for name in trucks[0].minutes
        },
        "cpu_s_per_truck": round(float(np.mean([truck.cpu_s for truck in trucks])), 1),
    }
    goals = {"worst_estimate_inside": GOAL, "worst_curvature_error": CURVATURE, "light": light_goals}
    met = fine and worst >= GOAL and max(modes.values()) <= CURVATURE
    print(json.dumps({"bench": "calibration", "figures": sums, "goals": goals, "met": met}))
    return 0 if met else 1


if __name__ == "__main__":
    sys.exit(main())
