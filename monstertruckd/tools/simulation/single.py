"""One emulated device alone on a pty, in the default world."""

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path

from monstertruck_drivers.ax12.config import Ax12Config
from monstertruck_drivers.base import Emulator
from monstertruck_drivers.catalog import find_kind
from monstertruck_drivers.epos.emulator import EposEmulator
from monstertruck_drivers.hokuyo_urg.emulator import HokuyoEmulator
from monstertruck_drivers.maestro.emulator import MaestroEmulator
from monstertruck_drivers.os4000.emulator import Os4000Emulator
from monstertruck_drivers.pty_port import PtyPort
from monstertruck_drivers.webcam.emulator import WebcamEmulator
from monstertruck_runtime.clock import Clock
from monstertruck_runtime.errors import InputError
from monstertruck_sim.console import Emulated
from monstertruck_sim.robot import LINE_BAUD, stabiliser_bus
from monstertruck_sim.world.config import WorldConfig
from monstertruck_sim.world.world import World


@asynccontextmanager
async def emulate_device(device: str, link: Path, clock: Clock, seed: int) -> AsyncIterator[Emulated]:
    """Serve ``device`` (kind or role) behind the symlink ``link`` while the context lasts.

    Raises:
        InputError: unknown device, or one without a port.
    """
    world = World(WorldConfig(), seed)
    port = PtyPort(link)
    emulator: Emulator
    match find_kind(device).role:
        case "lidar":
            emulator = HokuyoEmulator(clock, world.lidar, seed=seed)
        case "compass":
            emulator = Os4000Emulator(clock, world.compass, seed=seed)
        case "drive":
            emulator = EposEmulator(clock, world.motor, seed=seed)
        case "stabiliser":
            emulator = stabiliser_bus(Ax12Config(), clock, seed)
        case "camera":
            emulator = WebcamEmulator(clock, world.view, usb=port)
        case "steering":
            emulator = MaestroEmulator(clock, world.servos, seed=seed)
        case role:
            raise InputError(f"{role}: the computer's own files, no device on a port; simulate emulates them")
    port.device.baud = LINE_BAUD.get(find_kind(device).role)
    task = asyncio.create_task(emulator.run(port.device), name=f"emulator {device}")
    port.plug()
    try:
        yield Emulated(emulator, port)
    finally:
        port.unplug()
        task.cancel()
        await asyncio.wait([task])
