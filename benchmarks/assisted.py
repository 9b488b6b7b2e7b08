"""Compare assisted with bare driving: random sticks in three worlds, with and without ``gate.assist.on``.

    python benchmarks/assisted.py [--drives 5] [--seconds 40] [--first 0]

The whole daemon drives on the virtual clock. A stick at full speed changes its steering at random every 1 to 4 s, and
one time in six it reverses for a second. The same seed moves the same stick in both runs.

``metres`` is the distance travelled, ``stops`` counts stops before an obstacle or unseen ground, ``contacts`` drives
in which the true footprint touched something. The last line is JSON.
"""

import argparse
import json
from typing import Any

import numpy as np

from benchmarks import ROOT
from monstertruck_runtime.clock import SECOND, VirtualClock, run_virtual
from monstertruck_schemas import topics
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import DriveRequest
from monstertruckd.config.load import load_config
from monstertruckd.tools.simulation.config import SimulatedTruckConfig, with_overlay
from monstertruckd.tools.simulation.operator import LocalOperator
from monstertruckd.tools.simulation.virtual_rig import VirtualRig

CONFIG = ROOT / "configs" / "demo.yaml"
WORLDS = ("loop", "rooms", "corridor_maze")
PERIOD = 0.1
"""Period of the stick's requests, s."""
STOPS = frozenset({Reason.OBSTACLE_STOP, Reason.UNSEEN_STOP})


def stick(seed: int, seconds: float) -> list[tuple[float, float]]:
    """Return speed (m/s) and front angle (rad) of each request."""
    rng = np.random.default_rng([4, seed])
    asked: list[tuple[float, float]] = []
    while len(asked) < seconds / PERIOD:
        back = rng.random() < 1 / 6
        count = round((1.0 if back else rng.uniform(1.0, 4.0)) / PERIOD)
        asked += [(-0.1 if back else 0.2, float(rng.choice((0.0, 0.0, rng.uniform(-0.4, 0.4)))))] * count
    return asked


def drive(world: str, seed: int, seconds: float, *, assisted: bool) -> dict[str, float]:
    """Simulate one drive."""
    config = load_config(CONFIG, SimulatedTruckConfig)[0].model_copy(update={"path": None, "recorder": None})
    changes: dict[str, Any] = {"sim": {"seed": seed, "world": {"map": world}}}
    config = with_overlay(config, changes | {"blackbox": None, "gate": {"assist": {"on": assisted}}})
    row = {"metres": 0.0, "stops": 0.0, "contacts": 0.0}

    async def main(clock: VirtualClock) -> None:
        rig = VirtualRig(config, clock)
        async with rig.running():
            await clock.sleep(3.0)
            operator = LocalOperator(rig.daemon, clock)
            await operator.arm()
            before: frozenset[Reason] = frozenset()
            for speed, front in stick(seed, seconds):
                request = {**await operator.header(0.3), "speed": speed, "front": front, "rear": -front}
                rig.bus.inject(topics.REQ_DRIVE, DriveRequest.model_validate_json(json.dumps(request)))
                await clock.sleep(PERIOD)
                gate = rig.bus.newest(topics.GATE)
                reasons = frozenset(() if gate is None else gate.reasons) & STOPS
                row["stops"] += bool(reasons) and not before
                before = reasons
            truth = rig.truth.array()
        row["metres"] = float(np.hypot(*np.diff(truth[:, 1:3], axis=0).T).sum())
        row["contacts"] = float(truth[:, 5].any())

    run_virtual(main, start=SECOND)
    return row


def main() -> None:
    """Run all drives and print the sums."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--drives", type=int, default=5, help="in each world")
    parser.add_argument("--seconds", type=float, default=40.0)
    parser.add_argument("--first", type=int, default=0)
    options = parser.parse_args()
    figures: dict[str, Any] = {"drives": options.drives * len(WORLDS), "seconds": options.seconds}
    print("| world | assisted | metres | stops | contacts |\n|---|---|---|---|---|")
    for world in WORLDS:
        for assisted in (False, True):
            rows = [
                drive(world, seed, options.seconds, assisted=assisted)
                for seed in range(options.first, options.first + options.drives)
            ]
            sums = {name: round(sum(row[name] for row in rows), 2) for name in rows[0]}
            print(
                f"| {world} | {'yes' if assisted else 'no'} | " + " | ".join(map(str, sums.values())) + " |", flush=True
            )
            for name, value in sums.items():
                key = f"{'assisted' if assisted else 'bare'}_{name}"
                figures[key] = round(figures.get(key, 0.0) + value, 2)
    goals = {"assisted_contacts": 0, "assisted_metres_per_bare": 1.5, "assisted_stops_per_bare": 0.5}
    figures["assisted_metres_per_bare"] = round(figures["assisted_metres"] / max(figures["bare_metres"], 0.01), 2)
    figures["assisted_stops_per_bare"] = round(figures["assisted_stops"] / max(figures["bare_stops"], 1.0), 2)
    met = (
        figures["assisted_contacts"] <= goals["assisted_contacts"]
        and figures["assisted_metres_per_bare"] >= goals["assisted_metres_per_bare"]
        and figures["assisted_stops_per_bare"] <= goals["assisted_stops_per_bare"]
    )
    print(json.dumps({"bench": "assisted", "figures": figures, "goals": goals, "met": met}))


if __name__ == "__main__":
    main()
