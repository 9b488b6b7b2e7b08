"""A truck of emulated devices in a simulated world, with any clock and any kind of port."""

import asyncio
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from monstertruck_drivers.cable import EmulatedPort, MemoryPort
from monstertruck_drivers.catalog import DeviceKind
from monstertruck_drivers.config import Devices, Monitors, kind_of
from monstertruck_drivers.emulation import Emulator, EmulatorSetup, FileEmulator
from monstertruck_drivers.epos.emulator import EposEmulator
from monstertruck_drivers.hokuyo_urg.recording import RecordedHokuyoEmulator, RecordedRanges
from monstertruck_drivers.maestro.emulator import MaestroEmulator
from monstertruck_runtime.clock import Clock
from monstertruck_runtime.threads import Offload, in_thread
from monstertruck_schemas.base import Schema
from monstertruck_schemas.roles import DeviceRole
from monstertruck_sim.config import SimConfig
from monstertruck_sim.world.scene import Surroundings
from monstertruck_sim.world.world import World


def carries_lidar(devices: Devices) -> bool:
    """Whether the robot carries a lidar, or at least its stabilised mount."""
    return devices.lidar is not None or devices.stabiliser is not None


class SimulatedRobot:
    """World and emulators, wired as on the truck.

    Args:
        config: simulation settings.
        devices: devices of the robot, with their settings.
        monitors: monitors of the computer.
        clock: clock of the world and the devices.
        ports: one emulated port per device role; ``run`` plugs them in.
        root: folder of the emulated computer, for its monitors.
        offload: runs the rendering of camera images.
        scene: world shared with other robots; None for a separate world.
        name: name of the robot.
    """

    def __init__(
        self,
        config: SimConfig,
        devices: Devices,
        monitors: Monitors,
        clock: Clock,
        ports: Mapping[str, EmulatedPort],
        root: Path,
        offload: Offload = in_thread,
        scene: Surroundings | None = None,
        name: str = "truck",
    ) -> None:
        self.world = World(config.world, config.seed, scene, name, lidar=carries_lidar(devices))
        self.ports = ports
        self.recorded: RecordedHokuyoEmulator | None = None

        def emulated(role: str, kind: DeviceKind, settings: Schema) -> Any:
            port = ports.get(role) or MemoryPort(role)
            setup = EmulatorSetup(role, settings, clock, self.world, config.seed, port, root, offload)
            return kind.emulated(setup)

        self.monitored: dict[str, FileEmulator] = {
            role: emulated(role, kind_of(settings), settings) for role, settings in monitors.present().items()
        }
        """Emulated files of the computer, by monitor."""
        self._kinds = {role: device.kind for role, device in devices.present().items()}
        self.emulators: dict[str, Emulator] = {
            role: emulated(role, device.kind, device.driver) for role, device in devices.present().items()
        }
        if DeviceRole.LIDAR in self.emulators and config.recording is not None:
            self.recorded = RecordedHokuyoEmulator(clock, RecordedRanges.load(config.recording), seed=config.seed)
            self.emulators[DeviceRole.LIDAR] = self.recorded
        self._wire_deadman(config, devices)

    def _wire_deadman(self, config: SimConfig, devices: Devices) -> None:
        """Set the servo controller's timeout and connect its output to the drive controllers' quick-stop inputs."""
        maestro = self.emulators.get(DeviceRole.STEERING)
        if devices.steering is None or not isinstance(maestro, MaestroEmulator):
            return
        maestro.set_serial_timeout(config.servo_timeout)
        deadman = devices.steering.driver.deadman_channel if config.deadman_wired else None

        def output_changed(channel: int, high: bool) -> None:
            if channel == deadman:
                for emulator in self.emulators.values():
                    if isinstance(emulator, EposEmulator):
                        emulator.set_quick_stop_input(not high)

        maestro.on_output = output_changed

    async def run(self) -> None:
        """Plug everything in and serve until cancelled."""
        try:
            async with asyncio.TaskGroup() as group:
                for role, emulator in self.emulators.items():
                    port = self.ports[role]
                    group.create_task(self._kinds[role].serve(emulator, port.device), name=f"emulator {role}")
                    port.plug()
                for name, files in self.monitored.items():
                    group.create_task(files.run(), name=f"emulator {name}")
        finally:
            for port in self.ports.values():
                port.unplug()
