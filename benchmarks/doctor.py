"""The doctor against faults drawn from a catalogue: found faults, their fixes, and false findings.

    python -m benchmarks.doctor [--seeds 100]
    python -m benchmarks.doctor --drive 20

First every fault of ``tests/unit/tools/doctor/catalogue.py`` alone, then ``--seeds`` computers with up to six of them
at once, then a healthy one. The computers are folders with emulated USB trees, networks and logs.

``--drive``: number of trucks, at random places of the built-in worlds, that the doctor drives 20 cm through the whole
daemon on the virtual clock. Every second one is healthy, with calibrated servos; each of the others has one wrong sign.
"""

import argparse
import json
import logging
import sys
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from benchmarks import ROOT
from benchmarks.exploration_parts.arena import Arena
from monstertruck_runtime.clock import VirtualClock, run_virtual
from monstertruck_runtime.map_files import FREE
from monstertruck_sim.world.built_in import BUILT_IN
from monstertruckd.config.load import load_config
from monstertruckd.tools.calibrate.motion import Mover
from monstertruckd.tools.doctor.context import Finding, Level
from monstertruckd.tools.doctor.drive import signs
from monstertruckd.tools.simulation.config import SimulatedTruckConfig, with_overlay
from monstertruckd.tools.simulation.virtual_rig import VirtualRig
from tests.calibration_kit import START_UP, LocalTruck
from tests.unit.tools.doctor.catalogue import FAULTS, Fault, drawn, examined, log, mistakes, weaving

WORLDS = "yard", "hall", "loop", "rooms", "corridor_maze"
SERVOS = {"front_servo": (1, 1461.0, -9.9), "rear_servo": (0, 1422.0, -10.9)}
"""Channel, centre (us) and scale (us/deg) of those that the shipped configuration believes in."""
WRONG = {
    "sign motor": {"truck": {"motor": {"inverted": False}}},
    "sign steering": {"truck": {"front_servo": {"us_per_degree": 9.9}, "rear_servo": {"us_per_degree": 10.9}}},
    "sign lidar": {"lidar": {"yaw": 3.14159}},
}
"""By the finding that it has to be."""
OUTPUT = ROOT / "runs" / "benchmarks" / "doctor.json"
GOALS = {"catalogue": 40, "not_found": 0, "without_mend": 0, "false": 0}


def wrong_with(faults: Sequence[Fault], *, drove: bool = False) -> list[str]:
    """Return the doctor's mistakes on one computer."""
    with TemporaryDirectory(prefix="monstertruck-") as folder:
        before = log(*weaving()) if drove else lambda _: None
        return mistakes(examined(Path(folder), faults, before), faults)


def driven(seed: int, wrong: str | None) -> list[Finding]:
    """Return the findings about one driven truck."""
    rng = np.random.default_rng([seed, 27])
    name = WORLDS[seed // 2 % len(WORLDS)]
    built = BUILT_IN[name]().map
    x, y, yaw = Arena.of(name, built.cells != FREE, built.resolution, built.origin[:2]).start(seed)
    servos = {
        servo: {
            "channel": channel,
            "centre_us": centre + rng.uniform(-4.0, 4.0),
            "us_per_degree": scale * rng.uniform(0.98, 1.02),
        }
        for servo, (channel, centre, scale) in SERVOS.items()
    }
    world = {"map": name, "start": {"x": x, "y": y, "yaw": yaw}, "truck": servos}
    base = load_config(ROOT / "configs" / "yard.yaml", SimulatedTruckConfig)[0]
    with TemporaryDirectory(prefix="monstertruck-") as folder:
        quiet = {"recorder": None, "blackbox": None, "state_directory": Path(folder)}
        config = with_overlay(base, quiet | {"sim": {"world": world}})
        if wrong is not None:
            config = with_overlay(config, {"sim": {"world": WRONG[wrong]}})

        async def main(clock: VirtualClock) -> list[Finding]:
            rig = VirtualRig(config, clock)
            async with rig.running():
                await clock.sleep(START_UP)
                mover = Mover(LocalTruck(rig.daemon, clock, "doctor"), clock, config.chassis())  # type: ignore[arg-type]
                return await signs(
                    lambda step: mover.move(step, lambda *_: None), config, lambda *words: " ".join(words)
                )

        return run_virtual(main)


def drives(count: int) -> int:
    """Drive; 0: no false finding on a healthy truck, and every wrong sign is named alone."""
    logging.disable(logging.CRITICAL)
    false, missed = 0, 0
    for seed in range(count):
        wrong = None if seed % 2 == 0 else list(WRONG)[seed // 2 % len(WRONG)]
        found = [finding for finding in driven(seed, wrong) if finding.level is not Level.OK]
        others = [f"{finding.check}: {finding.seen}" for finding in found if finding.check != wrong]
        missing = wrong is not None and all(finding.check != wrong for finding in found)
        print(f"{seed}: {wrong or 'healthy'}: {'; '.join(others) or ('not found' if missing else 'right')}", flush=True)
        false, missed = false + bool(others), missed + missing
    figures, goals = {"trucks": count, "false": false, "not_found": missed}, {"false": 0, "not_found": 0}
    print(json.dumps({"bench": "doctor.drive", "figures": figures, "goals": goals, "met": not false and not missed}))
    return 0 if not false and not missed else 1


def main() -> int:
    """Examine; 0 = all goals are met."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=100)
    parser.add_argument("--drive", type=int, metavar="N", help="drive so many trucks instead")
    arguments = parser.parse_args()
    if arguments.drive:
        return drives(arguments.drive)
    wrong, met_faults = [], 0
    cases = [[fault] for fault in FAULTS]
    cases += [drawn(np.random.default_rng([seed, 26]), 6) for seed in range(arguments.seeds)]
    for faults in cases:
        met_faults += len(faults)
        found = wrong_with(faults)
        for text in found:
            print(f"{', '.join(fault.name for fault in faults)}: {text}", flush=True)
        wrong += found
    healthy = wrong_with([]) + wrong_with([], drove=True)
    for text in healthy:
        print(f"healthy: {text}", flush=True)
    wrong += healthy
    figures = {
        "catalogue": len(FAULTS),
        "computers": len(cases) + 2,
        "faults": met_faults,
        "not_found": sum(text.endswith(": not found") for text in wrong),
        "without_mend": sum(": no mend in " in text for text in wrong),
        "false": sum(text.startswith("false: ") for text in wrong),
    }
    met = figures["catalogue"] >= GOALS["catalogue"] and not wrong
    OUTPUT.parent.mkdir(parents=True, exist_ok=True)
    OUTPUT.write_text(json.dumps(figures, indent=1), encoding="utf-8")
    print(json.dumps({"bench": "doctor", "figures": figures, "goals": GOALS, "met": met}))
    return 0 if met else 1


if __name__ == "__main__":
    sys.exit(main())
