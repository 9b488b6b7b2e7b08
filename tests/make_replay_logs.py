"""``python -m tests.make_replay_logs``: short recorded runs that ``replay --check`` has to give again bit for bit.

Whole daemons on the virtual clock, of a fixed seed. To be made anew when the estimation, a planner or the
configuration changes on purpose, so that the recorded outputs or the attached configuration are no longer theirs.
"""

import shutil
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from monstertruck_runtime.clock import VirtualClock, run_virtual
from monstertruck_runtime.mailbox import fifo
from monstertruck_runtime.yaml_files import yaml_text
from monstertruck_schemas import topics
from monstertruck_schemas.base import Pose2D
from monstertruck_schemas.plan import GoalPhase
from monstertruck_schemas.req import GoalRequest, Role
from monstertruck_sim.world.obstacles import Box
from monstertruckd.config.load import FILE_VERSION, load_config, load_tree
from monstertruckd.tools.demo.runs import run_fast_demo, write_overlay
from monstertruckd.tools.logs.summary import info
from monstertruckd.tools.simulation.config import SimulatedTruckConfig
from monstertruckd.tools.simulation.operator import LocalOperator
from monstertruckd.tools.simulation.virtual_rig import VirtualRig

ROOT = Path(__file__).resolve().parents[1]
FOLDER = ROOT / "tests" / "data" / "replay"
RUNS = {"level": ("ramp.yaml", 0.2), "slam": ("slam.yaml", 0.8), "fusion": ("fusion.yaml", 0.6)}
"""Logs by name: configuration, and metres of the path: a rocking truck with a level lidar, and two that map."""
GOALS = ((0.25, -1.7), (0.43, -1.71))
"""Places (x, y) that the run ``goals`` drives to: asked for by topic, and by remote call."""
PLANNER = {
    "route": {"kind": "hybrid", "effort": 3000, "unknown": "free"},
    "local_planner": {"kind": "rsband"},
    "local": {"clearance": 0.6},
    "latency": 0.2,
}
"""Of that run: so much clearance is wanted that a box beside the routes deforms them."""


def short_config(source: Path, folder: Path, **changes: Any) -> Path:
    """``source`` with all it includes and ``changes``, without what fills a log: pictures, every beam."""
    config: dict[str, Any] = load_tree(source).data | {"version": FILE_VERSION} | changes
    config.pop("include", None)
    config["recorder"] = {"compression": "zstd"}
    config["map"] = None
    config["devices"]["camera"] = None
    config["devices"]["lidar"].setdefault("driver", {})["cluster"] = 3
    target = folder / "truck.yaml"
    target.write_text(yaml_text(config), encoding="utf-8")
    return target


def drive_path(source: str, length: float, folder: Path) -> None:
    """A straight path of ``length`` metres."""
    rows = [f"{x:.4f},-1.7000,0.00000,1" for x in np.arange(0.0, length + 1e-9, 0.05)]
    (folder / "path.csv").write_text("\n".join(["x,y,yaw,direction", *rows]) + "\n")
    config = short_config(ROOT / "configs" / source, folder, path={"file": "path.csv"})
    run_fast_demo(config, folder / "run", seed=1)


def drive_to_goals(folder: Path) -> None:
    """Two goals on a growing map."""
    config = short_config(ROOT / "configs" / "slam.yaml", folder, path=None, planner=PLANNER, tracker={"kind": "lqr"})
    overlay = write_overlay(config, folder / "run", "tcp/127.0.0.1:0", seed=1)
    truck, tree = load_config(overlay, SimulatedTruckConfig)

    async def main(clock: VirtualClock) -> None:
        rig = VirtualRig(truck, clock, tree)
        async with rig.running():
            operator = LocalOperator(rig.daemon, clock)
            states = rig.bus.subscribe(topics.GOAL, fifo(256))
            await clock.sleep(0.73)
            rig.world.add(clock.now(), Box(0.8, -1.35, 0.2, 0.2))
            for number, (x, y) in enumerate(GOALS, start=1):
                gate, now = rig.bus.newest(topics.GATE), clock.now()
                assert gate is not None
                request = GoalRequest(
                    stamp=now,
                    received=now,
                    seq=number,
                    frame="map",
                    source="tester",
                    role=Role.STATION,
                    lease=1.0,
                    nonce=gate.nonce,
                    gate_stamp=gate.stamp,
                    goal=Pose2D(x=x, y=y, yaw=0.0),
                )
                if number == 1:
                    rig.bus.inject(topics.REQ_GOAL, request)
                    await operator.arm()
                else:
                    await rig.daemon.rpc.call("goal", request.model_dump(mode="json"))
                async with clock.deadline(20.0):
                    while (state := await states.next()).number < number or state.phase is not GoalPhase.IDLE:
                        pass
            await clock.sleep(0.13)

    run_virtual(main)


def record(name: str, target: Path) -> None:
    """Drive the run ``name`` and leave its log at ``target``."""
    with tempfile.TemporaryDirectory(prefix="replay-") as scratch:
        folder = Path(scratch)
        if name == "goals":
            drive_to_goals(folder)
        else:
            drive_path(*RUNS[name], folder)
        (log,) = (folder / "run" / "logs").glob("*.mcap")
        shutil.copy(log, target)


def main() -> None:
    """Write all logs."""
    FOLDER.mkdir(parents=True, exist_ok=True)
    for name in (*RUNS, "goals"):
        log = FOLDER / f"{name}.mcap"
        record(name, log)
        summary = info(log)
        print(log, f"{log.stat().st_size / 1e3:.0f} kB, {summary['duration']:.1f} s, {summary['messages']} messages")


if __name__ == "__main__":
    main()
