"""Levelling of the lidar on a rocking truck: with compass, planner, driver and both emulated AX-12A, and without.

Prints the true tilt of the lidar with the stabiliser on and off, and the tilt stated by the daemon in its scans; draws
the map of a lap on the rocking truck both ways into docs/pictures. The last line is JSON.

    python benchmarks/stabiliser.py [--quick]      (quick: no pictures)
"""

import json
import sys
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from benchmarks import ROOT
from monstertruck_drivers.ax12.emulator import TrueJoints
from monstertruck_estimation.scan_tilt import plane_tilt
from monstertruck_runtime.clock import SECOND, VirtualClock, run_virtual
from monstertruck_runtime.mailbox import fifo
from monstertruck_schemas import topics
from monstertruckd.config.load import load_config
from monstertruckd.tools.simulation.config import SimulatedTruckConfig, with_overlay
from monstertruckd.tools.simulation.operator import LocalOperator, drive_lap
from monstertruckd.tools.simulation.virtual_rig import VirtualRig

RAMP = ROOT / "configs" / "ramp.yaml"
PICTURES = ROOT / "docs" / "pictures"
SETTLE, SECONDS = 3.0, 20.0
OFF: dict[str, Any] = {"devices": {"stabiliser": None}}
LEAN: dict[str, Any] = {"recorder": None, "devices": {"camera": None}, "monitors": {"link": None, "host": None}}
GOAL_RMS, GOAL_MAX = 1.0, 3.0


def ramp(*overlays: dict[str, Any]) -> SimulatedTruckConfig:
    config = load_config(RAMP, SimulatedTruckConfig)[0]
    for overlay in (LEAN, *overlays):
        config = with_overlay(config, overlay)
    return config


def tilts(config: SimulatedTruckConfig, seconds: float = SECONDS) -> dict[str, float]:
    """Return RMS and maximum true tilt of the lidar, and error of the tilt stated in its scans, degrees."""

    async def main(clock: VirtualClock) -> dict[str, float]:
        rig = VirtualRig(config, clock)
        stabiliser = config.devices.stabiliser
        joints = None
        if stabiliser is not None:
            joints = TrueJoints(rig.robot.emulators["stabiliser"], stabiliser.driver)  # type: ignore[arg-type]

        def tilt(time_ns: int) -> float:
            state = rig.world.truth(time_ns)
            angles = (0.0, 0.0)
            if joints is not None:
                pitch, roll = joints.angles(np.array([time_ns]))
                angles = (float(pitch[0]), float(roll[0]))
            return plane_tilt(state.roll, state.pitch, *angles)

        scans = rig.bus.subscribe(topics.SCAN, fifo(4096))
        true: list[tuple[int, float]] = []
        async with rig.running():
            await clock.sleep(SETTLE)
            scans.drain()
            for _ in range(round(seconds * 100)):
                await clock.sleep(0.01)
                true.append((clock.now(), tilt(clock.now())))
        times, angles = np.array([t for t, _ in true]), np.degrees([a for _, a in true])
        said = [
            (s.stamp + round(s.time_increment * len(s.ranges) / 2 * SECOND), np.degrees(s.tilt))
            for s in scans.drain()
            if s.tilt is not None
        ]
        errors = np.array([a - np.interp(t, times, angles) for t, a in said if times[0] <= t <= times[-1]])
        return {
            "rms_deg": float(np.sqrt(np.mean(angles**2))),
            "max_deg": float(angles.max()),
            "stated_error_rms_deg": float(np.sqrt(np.mean(errors**2))),
            "stated_error_max_deg": float(np.abs(errors).max()),
            "scans": len(said),
        }

    return run_virtual(main, start=SECOND)


def draw_map(config: SimulatedTruckConfig) -> str:
    """Drive a lap; the daemon saves the picture of the map."""

    async def main(clock: VirtualClock) -> str:
        rig = VirtualRig(config, clock)
        async with rig.running():
            lap = await drive_lap(LocalOperator(rig.daemon, clock), clock)
            await clock.sleep(1.0)
        return lap.outcome.value

    return run_virtual(main, start=SECOND)


def pictures() -> dict[str, str]:
    outcomes = {}
    with TemporaryDirectory() as folder:
        for name, overlay in (("on", {}), ("off", OFF)):
            file = Path(folder) / f"{name}.png"
            everything = {"map": {"max_tilt": 1.57, "picture": file}}
            outcomes[name] = draw_map(ramp(overlay, everything))
            (PICTURES / f"stabiliser-{name}.png").write_bytes(file.read_bytes())
    return outcomes


def main() -> None:
    on, off = tilts(ramp()), tilts(ramp(OFF))
    print("body rocking by 15 degrees at 0.5 Hz    RMS      greatest   tilt stated in scans: RMS error")
    for name, row in (("stabiliser on", on), ("stabiliser off", off)):
        print(f"{name:38} {row['rms_deg']:6.2f} deg {row['max_deg']:6.2f} deg {row['stated_error_rms_deg']:10.2f} deg")
    figures: dict[str, Any] = {"on": on, "off": off}
    if "--quick" not in sys.argv:
        figures["laps"] = pictures()
    met = on["rms_deg"] <= GOAL_RMS and on["max_deg"] <= GOAL_MAX
    goals = {"rms_deg": GOAL_RMS, "max_deg": GOAL_MAX}
    print(json.dumps({"bench": "stabiliser", "figures": figures, "goals": goals, "met": met}))


if __name__ == "__main__":
    main()
