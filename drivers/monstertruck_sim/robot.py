"""A truck of emulated devices in a simulated world, on any clock and any kind of port."""

import asyncio
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from monstertruck_drivers.ax12.config import Ax12Config
from monstertruck_drivers.ax12.emulator import Ax12Bus
from monstertruck_drivers.ax12.protocol import BAUD, STEP
from monstertruck_drivers.base import Emulator
from monstertruck_drivers.battery.emulator import IioEmulator
from monstertruck_drivers.battery.iio import CONVERTERS
from monstertruck_drivers.cable import EmulatedPort
from monstertruck_drivers.config import Devices, Monitors
from monstertruck_drivers.epos.emulator import EposEmulator
from monstertruck_drivers.hokuyo_urg.emulator import HokuyoEmulator
from monstertruck_drivers.hokuyo_urg.recording import RecordedHokuyoEmulator, RecordedRanges
from monstertruck_drivers.host_health.emulator import HostEmulator
from monstertruck_drivers.link_quality.emulator import NetworkEmulator
from monstertruck_drivers.maestro.emulator import MaestroEmulator
from monstertruck_drivers.os4000.emulator import Os4000Emulator
from monstertruck_drivers.webcam.emulator import WebcamEmulator
from monstertruck_runtime.clock import Clock
from monstertruck_runtime.threads import Offload, in_thread
from monstertruck_schemas.roles import SHAFTS
from monstertruck_sim.config import SimConfig
from monstertruck_sim.console import FileEmulator
from monstertruck_sim.world.world import World

LINE_BAUD: dict[str, int] = {**dict.fromkeys(SHAFTS, 38400), "stabiliser": BAUD}
"""Serial lines whose speed is felt; the others are USB from end to end, or have a byte now and then."""


class SimulatedRobot:
    """World and emulators, wired as on the truck.

    Args:
        config: the simulated side's settings.
        devices: the robot's, with their settings.
        monitors: what of the computer is watched.
        clock: time of world and devices.
        ports: one emulated port per device role; ``run`` plugs them in.
        root: folder of the emulated computer, for its monitors.
        offload: where the camera's pictures are drawn.
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
    ) -> None:
        self.world = World(config.world, config.seed)
        self.ports = ports
        self.emulators: dict[str, Emulator] = {}
        self.monitored = self._monitored(config, monitors, clock, root)
        """What the computer's files show, by monitor."""
        self.recorded: RecordedHokuyoEmulator | None = None
        present = devices.present()
        if "lidar" in present and config.recording is not None:
            self.recorded = RecordedHokuyoEmulator(clock, RecordedRanges.load(config.recording), seed=config.seed)
            self.emulators["lidar"] = self.recorded
        elif "lidar" in present:
            self.emulators["lidar"] = HokuyoEmulator(clock, self.world.lidar, seed=config.seed)
        if "compass" in present:
            self.emulators["compass"] = Os4000Emulator(clock, self.world.compass, seed=config.seed)
        shafts = devices.shafts()
        self.epos = tuple(
            EposEmulator(clock, motor, seed=config.seed + i) for i, motor in enumerate(self.world.motors[: len(shafts)])
        )
        self.emulators.update(zip(shafts, self.epos, strict=True))
        if devices.steering is not None:
            self._deadman_channel = devices.steering.driver.deadman_channel if config.deadman_wired else None
            self.emulators["steering"] = MaestroEmulator(
                clock,
                self.world.servos,
                seed=config.seed,
                serial_timeout_s=config.servo_timeout,
                on_output=self._output_changed,
            )
        if devices.stabiliser is not None:
            bus = stabiliser_bus(devices.stabiliser.driver, clock, config.seed)
            self.emulators["stabiliser"] = bus
            self.world.carry_lidar(TrueJoints(bus, devices.stabiliser.driver))
        if "camera" in present:
            port = ports["camera"]
            self.emulators["camera"] = WebcamEmulator(clock, self.world.view, offload=offload, usb=port)

    def _monitored(self, config: SimConfig, monitors: Monitors, clock: Clock, root: Path) -> dict[str, FileEmulator]:
        channel = config.world.battery.channel
        found: dict[str, FileEmulator] = {}
        if (iio := monitors.battery) is not None:
            found["battery"] = IioEmulator(
                root / CONVERTERS,
                clock,
                lambda time_ns: self.world.servos.analog_volts(channel, time_ns),
                seed=config.seed,
                channel=iio.channel,
                device=iio.device or "mcp3208",
            )
        if monitors.link is not None:
            found["link"] = NetworkEmulator(root, clock)
        if monitors.host is not None:
            found["host"] = HostEmulator(root, clock)
        return found

    async def run(self) -> None:
        """Plug everything in and serve until cancelled."""
        try:
            async with asyncio.TaskGroup() as group:
                for role, emulator in self.emulators.items():
                    port = self.ports[role]
                    port.device.baud = LINE_BAUD.get(role)
                    group.create_task(emulator.run(port.device), name=f"emulator {role}")
                    port.plug()
                for name, files in self.monitored.items():
                    group.create_task(files.run(), name=f"emulator {name}")
        finally:
            for port in self.ports.values():
                port.unplug()

    def _output_changed(self, channel: int, high: bool) -> None:
        if channel == self._deadman_channel:
            for epos in self.epos:
                epos.set_quick_stop_input(not high)


def stabiliser_bus(config: Ax12Config, clock: Clock, seed: int) -> Ax12Bus:
    """Both units, at rest where the lidar is parallel to the body."""
    joints = (config.pitch, config.roll)
    places = {joint.id: float(joint.zero) for joint in joints}
    return Ax12Bus(clock, [joint.id for joint in joints], seed=seed, positions=places)


class TrueJoints:
    """``JointSource``: where the shafts of an emulated stabiliser really are.

    Args:
        bus: the units.
        config: which unit turns what.
    """

    def __init__(self, bus: Ax12Bus, config: Ax12Config) -> None:
        self._bus = bus
        self._joints = (config.pitch, config.roll)

    def angles(self, times_ns: NDArray[np.int64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Pitch and roll of the mount, rad."""
        pitch, roll = (
            joint.direction * (self._bus.angles(joint.id, times_ns) - joint.zero * STEP) for joint in self._joints
        )
        return pitch, roll
