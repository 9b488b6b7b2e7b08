"""Inside the booted system: the emulated truck behind /dev/truck, and the traffic on its drive's wire.

    python emulated.py CONFIG LINES

``LINES`` receives one JSON object a line, times in s of CLOCK_MONOTONIC: ``{"t", "to_device", "hex"}`` for traffic on
the drive's cable, ``{"t", "v"}`` for the true speed in m/s, 20 times a second.
"""

import json
import shutil
import sys
from pathlib import Path
from typing import TextIO

from monstertruck_drivers.cable import PtyPort
from monstertruck_runtime.clock import SECOND, Clock, run_wall
from monstertruck_sim.config import SimConfig
from monstertruck_sim.world.config import WorldConfig
from monstertruck_sim.world.world import World
from monstertruckd.config.load import load_config
from monstertruckd.config.truck import TruckConfig
from monstertruckd.tools.simulation import simulate
from monstertruckd.tools.simulation.config import SimulatedTruckConfig


def main(config: Path, lines: Path) -> None:
    """Serve until SIGTERM."""
    with lines.open("a", buffering=1) as out:

        async def serve(clock: Clock) -> None:
            simulate.PtyPort = lambda path: tapped(path, clock, out)  # type: ignore[attr-defined]
            simulate.TruthLog = lambda world, _: Speeds(world, clock, out)
            await simulate.serve(clock, (emulated(config),), print, lines.with_suffix(".npz"))

        run_wall(serve)


def emulated(config: Path) -> SimulatedTruckConfig:
    """Return the truck of a configuration with real ports, served by these emulators instead of devices."""
    truck = load_config(config, TruckConfig)[0]
    return SimulatedTruckConfig.model_validate(truck.model_dump() | {"sim": SimConfig(world=WorldConfig(map="loop"))})


def tapped(path: Path, clock: Clock, out: TextIO) -> PtyPort:
    """Return a port accessible to the group of serial devices, as with udev; the drive's traffic is logged."""
    port = PtyPort(path)
    plug = port.plug

    def plug_for_all() -> None:
        plug()
        shutil.chown(path.resolve(), group="dialout")
        path.resolve().chmod(0o660)

    def write(to_device: bool, data: bytes) -> None:
        json.dump({"t": clock.now() / SECOND, "to_device": to_device, "hex": data.hex()}, out)
        out.write("\n")

    port.plug = plug_for_all
    if path.name == "drive":
        port.device.on_bytes = write
    return port


class Speeds(simulate.TruthLog):
    """Logs the true speed."""

    def __init__(self, world: World, clock: Clock, out: TextIO) -> None:
        super().__init__(world, clock)
        self.out = out

    async def run(self) -> None:
        """Run until cancelled."""
        while True:
            now = self._clock.now()
            json.dump({"t": now / SECOND, "v": self._world.truth(now).v}, self.out)
            self.out.write("\n")
            await self._clock.sleep(0.05)


if __name__ == "__main__":
    Path("/dev/truck").mkdir(exist_ok=True)
    main(Path(sys.argv[1]), Path(sys.argv[2]))
