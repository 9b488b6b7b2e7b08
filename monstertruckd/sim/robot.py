"""A truck of emulated devices in a simulated world, on any clock and any kind of port."""

import asyncio
from collections.abc import Mapping

from monstertruck_drivers.base import Emulator
from monstertruck_drivers.epos.emulator import EposEmulator
from monstertruck_drivers.hokuyo_urg.emulator import HokuyoEmulator
from monstertruck_drivers.hokuyo_urg.recording import RecordedHokuyoEmulator, RecordedRanges
from monstertruck_drivers.link import EmulatedPort
from monstertruck_drivers.maestro.emulator import MaestroEmulator
from monstertruck_drivers.os4000.emulator import Os4000Emulator
from monstertruck_drivers.world.world import World
from monstertruck_runtime.clock import Clock
from monstertruckd.config.truck import Devices
from monstertruckd.sim.config import SimConfig

EPOS_BAUD = 38400


class SimulatedRobot:
    """World and emulators, wired as on the truck.

    Args:
        config: the simulated side's settings.
        devices: which devices the truck has, and how its servo controller is configured.
        clock: time of world and devices.
        ports: one emulated port per device role, unplugged; ``run`` plugs them in.
    """

    def __init__(self, config: SimConfig, devices: Devices, clock: Clock, ports: Mapping[str, EmulatedPort]) -> None:
        self.world = World(config.world, config.seed)
        self.ports = ports
        self.emulators: dict[str, Emulator] = {}
        self.recorded: RecordedHokuyoEmulator | None = None
        present = devices.present()
        if "lidar" in present and config.recording is not None:
            self.recorded = RecordedHokuyoEmulator(clock, RecordedRanges.load(config.recording), seed=config.seed)
            self.emulators["lidar"] = self.recorded
        elif "lidar" in present:
            self.emulators["lidar"] = HokuyoEmulator(clock, self.world.lidar, seed=config.seed)
        if "compass" in present:
            self.emulators["compass"] = Os4000Emulator(clock, self.world.compass, seed=config.seed)
        if "drive" in present:
            self.epos = EposEmulator(clock, self.world.motor, seed=config.seed)
            self.emulators["drive"] = self.epos
        if devices.steering is not None:
            self._deadman_channel = devices.steering.driver.deadman_channel if config.deadman_wired else None
            self.emulators["steering"] = MaestroEmulator(
                clock,
                self.world.servos,
                seed=config.seed,
                serial_timeout_s=config.servo_timeout,
                on_output=self._output_changed,
            )

    async def run(self) -> None:
        """Plug everything in and serve until cancelled."""
        try:
            async with asyncio.TaskGroup() as group:
                for role, emulator in self.emulators.items():
                    port = self.ports[role]
                    if role == "drive":
                        port.device.baud = EPOS_BAUD
                    group.create_task(emulator.run(port.device), name=f"emulator {role}")
                    port.plug()
        finally:
            for port in self.ports.values():
                port.unplug()

    def _output_changed(self, channel: int, high: bool) -> None:
        if channel == self._deadman_channel:
            self.epos.set_quick_stop_input(not high)
