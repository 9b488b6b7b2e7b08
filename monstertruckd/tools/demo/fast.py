"""The demo on the virtual clock: one process, as fast as it computes, reproducible."""

import gc
from pathlib import Path

from monstertruck_runtime.clock import SECOND, VirtualClock, WallClock, run_virtual
from monstertruckd.config.load import load_config
from monstertruckd.tools.demo.summary import Summary, log_figures
from monstertruckd.tools.demo.wall import write_overlay
from monstertruckd.tools.simulation.config import SimulatedTruckConfig
from monstertruckd.tools.simulation.operator import Lap, LocalOperator, drive_lap
from monstertruckd.tools.simulation.virtual_rig import VirtualRig


def run_fast_demo(config_file: Path, folder: Path, seed: int | None) -> Summary:
    """Drive a lap on the virtual clock.

    Raises:
        NoAnswerError: the lap was not finished.
    """
    overlay = write_overlay(config_file, folder, "tcp/127.0.0.1:0", seed)
    config, tree = load_config(overlay, SimulatedTruckConfig)
    wall = WallClock()

    async def main(clock: VirtualClock) -> tuple[VirtualRig, Lap, float]:
        rig = VirtualRig(config, clock, tree)
        begin_wall, begin = wall.now(), clock.now()
        gc.freeze()  # as the daemon does at its start
        async with rig.running():
            lap = await drive_lap(LocalOperator(rig.daemon, clock), clock)
            await clock.sleep(1.0)
            speed = (clock.now() - begin) / (wall.now() - begin_wall)
        return rig, lap, speed

    try:
        rig, lap, speed = run_virtual(main, start=SECOND)
    finally:
        gc.unfreeze()
    late = rig.daemon.gate.lateness()
    return Summary(
        lap,
        rig.truth.array(),
        late.p99,
        late.max,
        *log_figures(folder),
        digest=rig.daemon.digest.hexdigest(),
        speedup=speed,
        closed=config.path is not None and config.path.closed,
    )
