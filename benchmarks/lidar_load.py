"""Work of the daemon with each lidar at its full rate, as a ratio to the URG-04LX; virtual clock, one process.

    python benchmarks/lidar_load.py [LIDAR ...]

The emulated truck follows the path of `configs/demo.yaml`, with scan odometry in the loop. `calls`: function calls of
Python and C per second of the robot's time, made by the daemon's code; emulators and the simulated world do not count.
Unlike times, two runs count the same. `bytes`: what the lidar sends a second.
"""

import json
import logging
import sys
from types import FrameType
from typing import Any, Final

from benchmarks import ROOT
from monstertruck_runtime.clock import SECOND, VirtualClock, run_virtual
from monstertruckd.config.load import load_config
from monstertruckd.tools.simulation.config import SimulatedTruckConfig, with_overlay
from monstertruckd.tools.simulation.operator import LocalOperator
from monstertruckd.tools.simulation.virtual_rig import VirtualRig

DEMO: Final = ROOT / "configs" / "demo.yaml"
LIDARS: Final[dict[str, dict[str, Any]]] = {
    "urg_04lx": {"kind": "hokuyo_urg"},
    "ld19": {"kind": "ld19"},
    "rplidar_a1": {"kind": "rplidar", "model": "a1"},
    "rplidar_a3": {"kind": "rplidar", "model": "a3"},
    "rplidar_c1": {"kind": "rplidar", "model": "c1"},
    "rplidar_s2": {"kind": "rplidar", "model": "s2"},
    "ust_10lx": {"kind": "hokuyo_lx"},
}
SPUN_UP: Final = 6.0
MEASURED: Final = 3.0
"""Seconds of the robot's time before and while work is counted."""
FAR_SIDE: Final = (
    "monstertruck_sim",
    "emulat",
    "firmware",
    "cable.py",
    "signals.py",
    "fault_table.py",
    "lidar_load.py",
)
"""Parts of the file names of code that no robot runs."""


class Calls:
    """Counts function calls of the daemon's code."""

    def __init__(self) -> None:
        self.count = 0
        self._counted: dict[str, bool] = {}

    def __call__(self, frame: FrameType, event: str, _argument: Any) -> None:
        """Process an event of the interpreter, see ``sys.setprofile``."""
        if event in ("call", "c_call"):
            name = frame.f_code.co_filename
            counted = self._counted.get(name)
            if counted is None:
                ours = "monstertruck" in name
                counted = self._counted[name] = ours and not any(part in name for part in FAR_SIDE)
            self.count += counted


def measured(driver: dict[str, Any]) -> dict[str, float]:
    """The row of one lidar."""
    config = load_config(DEMO, SimulatedTruckConfig)[0]
    settings = {"devices": {"lidar": {"driver": driver}}, "recorder": None, "map": None, "blackbox": None}
    config = with_overlay(config, settings)

    async def main(clock: VirtualClock) -> dict[str, float]:
        rig = VirtualRig(config, clock)
        async with rig.running():
            await clock.sleep(3.0)
            await LocalOperator(rig.daemon, clock).arm()
            await clock.sleep(SPUN_UP - 3.0)
            sent, calls = 0, Calls()

            def take(inward: bool, data: bytes) -> None:
                nonlocal sent
                sent += 0 if inward else len(data)

            rig.ports["lidar"].device.on_bytes = take
            sys.setprofile(calls)
            await clock.sleep(MEASURED)
            sys.setprofile(None)
        return {"calls": calls.count / MEASURED, "bytes": sent / MEASURED}

    return run_virtual(main, start=SECOND)


def main(names: list[str]) -> int:
    """Measure the lidars of these names, or all, and the URG."""
    logging.disable(logging.CRITICAL)
    rows: dict[str, dict[str, float]] = {}
    print("| lidar | sends | calls of the daemon, as a ratio to the URG-04LX |\n|---|---|---|")
    for name, driver in LIDARS.items():
        if not names or name in names or not rows:
            row = measured(driver)
            ratio = row["calls"] / next(iter(rows.values()), row)["calls"]
            rows[name] = {key: round(value) for key, value in row.items()} | {"ratio": round(ratio, 2)}
            print(f"| {name} | {row['bytes'] / 1000:.1f} kB/s | {ratio:.2f} |", flush=True)
    print(json.dumps({"bench": "lidar_load", "figures": rows, "goals": {}, "met": True}))
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
