"""The situations: drivers, USB service, udev rules and doctor on the kernel's own devices."""

import asyncio
import contextlib
import fcntl
import os
import pty
import struct
import subprocess
import sys
import termios
import time
import tty
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import numpy as np
import serial

from benchmarks.usb_kernel_parts.inside import ask, situation, until
from monstertruck_drivers.cable import DeviceEnd
from monstertruck_drivers.computer import ROOT, Machine, open_watcher
from monstertruck_drivers.epos.config import EposConfig
from monstertruck_drivers.epos.driver import EposDriver
from monstertruck_drivers.maestro.config import MaestroConfig
from monstertruck_drivers.maestro.driver import MaestroDriver
from monstertruck_drivers.maestro.emulator import MaestroEmulator
from monstertruck_drivers.tty import MAX_AGE, SerialPort
from monstertruck_drivers.usb.config import CycleMethod, PowerConfig, UsbConfig, UsbPortConfig
from monstertruck_drivers.usb.hub import HubCoordinator, UsbService
from monstertruck_drivers.usb.port import HubPort, PortPower
from monstertruck_drivers.usb.tree import (
    DEVICES,
    ancestors,
    at_present,
    parent_of,
    port_directory,
    port_of,
    read_tree,
    topology_of,
)
from monstertruck_runtime.clock import WallClock
from monstertruck_runtime.errors import DeviceError, DeviceLostError, PortBusyError
from monstertruck_runtime.mailbox import Mailbox, latest
from monstertruck_runtime.service import RestartPolicy, Service, supervise
from monstertruck_schemas.health import ServiceHealth, ServiceState
from monstertruck_schemas.reasons import Reason
from monstertruckd.config.load import load_config
from monstertruckd.config.truck import TruckConfig
from monstertruckd.tools.doctor.context import HostContext, inspect
from monstertruckd.tools.doctor.devices import handshakes, wiring
from monstertruckd.tools.install.files import Program, rules_text

CLOCK = WallClock()
MACHINE = Machine(CLOCK)
RETURN = 30.0
"""Seconds of the machine, which is some ten times slower than a computer, until a device must be back."""
USBDEVFS_DISCONNECT_CLAIM = 0x8108551B
GADGET = "0525:a4a7"
"""Kind of the CDC-ACM device."""
JOYSTICK = "1d6b:0104"
DEVICE_SIDE = Path("/dev/ttyGS0")


def by_serial(serial: str) -> str:
    """Return the place of the device with that serial number."""
    return next(name for name, device in read_tree(MACHINE.sysfs).devices.items() if device.serial == serial)


def by_id(usb_id: str) -> str:
    """Return the place of the device of that kind."""
    return next(name for name, device in read_tree(MACHINE.sysfs).devices.items() if device.usb_id == usb_id)


def place(name: str, **more: Any) -> UsbPortConfig:
    """Return the settings of a port, by the kernel's name of its device."""
    return UsbPortConfig(hub=str(parent_of(name)), port=port_of(name), **more)


def tty_of(name: str) -> Path | None:
    """Return the node of a device."""
    device = read_tree(MACHINE.sysfs).devices.get(name)
    return Path("/dev", device.tty.name) if device is not None and device.tty is not None else None


class Kept:
    """Publisher that keeps all messages."""

    def __init__(self) -> None:
        self.kept: list[Any] = []

    def put(self, message: Any) -> None:
        """Keep a message."""
        self.kept.append(message)

    def next_seq(self) -> int:
        """Sequence number of the next message."""
        return len(self.kept)


class Events:
    """Sink that keeps the reasons of events."""

    def __init__(self) -> None:
        self.reasons: list[Reason] = []

    def __call__(self, reason: Reason, *_: Any, **__: Any) -> None:
        """Keep a reason."""
        self.reasons.append(reason)


class Robot:
    """Drive and steering by hub and port, and the service that watches the tree."""

    def __init__(self) -> None:
        self.events, self.tree = Events(), Kept()
        self.rows: dict[str, list[ServiceHealth]] = {"drive": [], "steering": []}
        self.ports = {"drive": place(by_serial("SNs1")), "steering": place(by_id(GADGET))}
        config = UsbConfig()
        self.hubs = HubCoordinator(config, self.ports, CLOCK, self.events)
        self.usb = UsbService(config, MACHINE, self.hubs, open_watcher(), self.tree, self.events)
        ends = {role: HubPort(port, MACHINE, self.events, self.hubs, None, role) for role, port in self.ports.items()}
        self.drive, self.steering = Kept(), Kept()
        self.drivers: dict[str, Service] = {
            "drive": EposDriver(EposConfig(), ends["drive"], CLOCK, Mailbox(latest()), self.drive, self.events),
            "steering": MaestroDriver(
                MaestroConfig(), ends["steering"], CLOCK, Mailbox(latest()), self.steering, None, self.events
            ),
        }

    def ready(self, role: str) -> bool:
        """Whether the service works."""
        return bool(self.rows[role]) and self.rows[role][-1].state is ServiceState.READY

    @asynccontextmanager
    async def running(self) -> AsyncIterator[None]:
        """All services."""
        rng = np.random.default_rng(1)
        tasks = [asyncio.create_task(self.usb.run(lambda: None))]
        for role, driver in self.drivers.items():
            tasks.append(
                asyncio.create_task(supervise(driver, RestartPolicy(max_delay=0.5), CLOCK, self.rows[role].append, rng))
            )
        try:
            yield
        finally:
            for task in reversed(tasks):
                task.cancel()
                await asyncio.wait([task])


class DeviceSide:
    """Device side of the CDC-ACM port, reopened after every disconnection of the host.

    Args:
        end: serves the bytes.
    """

    def __init__(self, end: DeviceEnd) -> None:
        self._end = end
        self._line = -1
        end.connect(self._write)

    async def run(self) -> None:
        """Run until cancelled."""
        loop = asyncio.get_running_loop()
        try:
            while True:
                with contextlib.suppress(OSError):
                    self._line = await asyncio.to_thread(os.open, DEVICE_SIDE, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
                    await asyncio.to_thread(tty.setraw, self._line, termios.TCSANOW)
                    gone = asyncio.Event()
                    loop.add_reader(self._line, self._read, gone)
                    await gone.wait()
                await self._close()
                await asyncio.sleep(0.2)
        finally:
            await self._close()

    def _read(self, gone: asyncio.Event) -> None:
        try:
            data = os.read(self._line, 4096)
        except BlockingIOError:
            return
        except OSError:
            data = b""
        if data:
            self._end.take(data)
        else:
            gone.set()

    def _write(self, data: bytes) -> None:
        with contextlib.suppress(OSError):
            os.write(self._line, data)

    async def _close(self) -> None:
        line, self._line = self._line, -1
        if line >= 0:
            asyncio.get_running_loop().remove_reader(line)
            await asyncio.to_thread(os.close, line)


@asynccontextmanager
async def servo_controller() -> AsyncIterator[None]:
    """A Maestro at the device's side of the CDC-ACM port."""
    end = DeviceEnd("device")
    tasks = [asyncio.create_task(MaestroEmulator(CLOCK).run(end)), asyncio.create_task(DeviceSide(end).run())]
    try:
        yield
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.wait(tasks)


async def tree() -> dict[str, Any]:
    """Check that every device has its node, including the joystick."""
    with contextlib.suppress(TimeoutError):
        await until(Path("/dev/input/js0").exists, 30)
    devices = read_tree(MACHINE.sysfs).devices
    nodes = sorted(node.name for device in devices.values() for node in device.nodes)
    hubs = [name for name, device in devices.items() if device.hub]
    return {
        "ok": nodes == ["ttyACM0", "ttyUSB0", "ttyUSB1", "ttyUSB2"] and Path("/dev/input/js0").exists(),
        "nodes": nodes,
        "hubs": hubs,
        "joystick": MACHINE.sysfs.text(f"bus/usb/devices/{by_id(JOYSTICK)}:1.0/uevent"),
        "latency_ms": sorted({node.latency_ms for device in devices.values() for node in device.nodes} - {None}),
    }


def control_lines(node: Path) -> tuple[bool, bool]:
    """Return DTR and RTS as set by this process; another open would raise both."""
    for entry in Path("/proc/self/fd").iterdir():
        with contextlib.suppress(OSError):
            if str(entry.readlink()) == str(node):
                (state,) = struct.unpack("I", fcntl.ioctl(int(entry.name), termios.TIOCMGET, b"\0" * 4))
                return bool(state & termios.TIOCM_DTR), bool(state & termios.TIOCM_RTS)
    raise LookupError(node)


async def switch(name: str, *, on: bool) -> None:
    """Unplug or plug in the cable at a place, as seen by the kernel."""
    await asyncio.to_thread(MACHINE.sysfs.write, f"{port_directory(name)}/disable", "0" if on else "1")


async def open_and_close() -> dict[str, Any]:
    """Open and close every adapter ten times; check the control lines."""
    lines = {}
    for number in ("SNs1", "SNs2", "SNs3"):
        for nth in range(10):
            node = tty_of(by_serial(number))
            assert node is not None
            async with await SerialPort(node, dtr=nth % 2 == 0, rts=nth % 3 == 0).open() as link:
                link.write(b"hello")
                lines[nth] = control_lines(node)
    wanted = {nth: (nth % 2 == 0, nth % 3 == 0) for nth in range(10)}
    return {"ok": lines == wanted, "lines": lines}


async def deaf() -> dict[str, Any]:
    """A device that accepts no bytes: its link ends, and its port stays wedged until the kernel releases it."""
    node = tty_of(by_id(GADGET))
    assert node is not None
    port = SerialPort(node)
    link = await port.open()
    begin, sent = time.monotonic(), 0
    while not link.is_lost and time.monotonic() - begin < 10:
        link.write(b"\x84\x00\x70\x2e")
        sent += 1
        await asyncio.sleep(0.02)
    gave_up = time.monotonic() - begin
    doctor = asyncio.create_task(doctors_handshakes())
    reasons: list[str] = []
    begin = time.monotonic()
    while time.monotonic() - begin < 60:
        try:
            (await port.open()).close()
        except DeviceError as error:
            reasons.append(error.reason.value)
            await asyncio.sleep(0.5)
        else:
            break
    free_after = time.monotonic() - begin
    ok = link.is_lost and gave_up < 1.0 and set(reasons) == {"device_wedged"} and free_after < 45
    seen = await doctor
    ok = ok and seen.get("steering handshake") == "device_wedged"
    found = {"gave_up_s": gave_up, "sent": sent, "free_after_s": free_after, "refused": len(reasons)}
    return {"ok": ok, **found, "doctor": seen}


async def listens_again() -> dict[str, Any]:
    """A deaf device that accepts bytes again receives only bytes within the age limit."""
    node = tty_of(by_id(GADGET))
    assert node is not None
    link = await SerialPort(node).open()
    sent = 0
    begin = time.monotonic()
    while time.monotonic() - begin < 3.0:
        with contextlib.suppress(DeviceLostError):
            link.write(b"\x84\x00\x70\x2e")
            sent += 1
        await asyncio.sleep(0.02)
    heard: list[bytes] = []
    end = DeviceEnd("listener")
    end.on_bytes = lambda to_device, data: heard.append(data) if to_device else None
    listening = asyncio.create_task(DeviceSide(end).run())
    await asyncio.sleep(2)
    await until(lambda: not closing(), 45)
    listening.cancel()
    await asyncio.wait([listening])
    count = len(b"".join(heard))
    return {"ok": 0 < count <= 4 * 2 * MAX_AGE / 0.02, "heard_bytes": count, "written": sent}


def closing() -> bool:
    """Whether any port is still being closed."""
    import threading  # noqa: PLC0415

    return any(thread.name == "serial port" for thread in threading.enumerate())


async def drivers() -> dict[str, Any]:
    """Drive on an FTDI adapter, steering on CDC-ACM; then the steering's cable is pulled while it writes."""
    robot = Robot()
    async with servo_controller(), robot.running():
        ready = await until(lambda: robot.ready("drive") and robot.ready("steering"), 60)
        before = len(robot.drive.kept), len(robot.steering.kept)
        await asyncio.sleep(3)
        rates = [(len(kept.kept) - b) / 3 for kept, b in zip((robot.drive, robot.steering), before, strict=True)]
        name = by_id(GADGET)
        await switch(name, on=False)
        await until(lambda: not robot.ready("steering"), 20)
        await switch(name, on=True)
        back = await until(lambda: robot.ready("steering"), RETURN)
        assert robot.ready("drive")
    return {"ok": min(rates) > 1, "ready_s": ready, "drive_hz": rates[0], "steering_hz": rates[1], "back_s": back}


async def hub_pulled() -> dict[str, Any]:
    """Pull a hub with two adapters while the drive works; it returns with other node numbers."""
    robot = Robot()
    async with servo_controller(), robot.running():
        await until(lambda: robot.ready("drive"), 60)
        lower, upper = sorted(str(tty_of(by_serial(f"SN{name}"))) for name in ("s1", "s2"))
        for name in ("s1", "s2", "h1"):
            await ask("device_del", id=name)
        await until(lambda: Reason.HUB_LOST in robot.events.reasons, 20)
        await asyncio.sleep(1)
        await ask("device_add", driver="usb-hub", id="h1", bus="x.0", port="1", **{"port-power": True})
        for name, port in (("s2", "1.2"), ("s1", "1.1")):
            line = {"chardev": f"c-{name}", "serial": f"SN{name}", "always-plugged": True}
            await ask("device_add", driver="usb-serial", id=name, port=port, **line)
            await until(lambda port=port: tty_of(f"1-{port}") is not None, 20)
        back = await until(lambda: Reason.HUB_RETURNED in robot.events.reasons and robot.ready("drive"), RETURN)
    nodes = {name: str(tty_of(by_serial(f"SN{name}"))) for name in ("s1", "s2")}
    return {"ok": nodes == {"s1": upper, "s2": lower}, "back_s": back, "nodes": nodes}


async def unplugged_in_mid_write() -> dict[str, Any]:
    """Unplug an adapter during a write; its port opens again at the same place."""
    name = by_serial("SNs3")
    port = HubPort(place(name), MACHINE, Events())
    link = await port.open()

    async def write() -> None:
        with contextlib.suppress(DeviceLostError):
            while True:
                link.write(b"0123456789" * 100)
                await asyncio.sleep(0.005)

    writing = asyncio.create_task(write())
    await asyncio.sleep(0.5)
    await ask("device_del", id="s3")
    await asyncio.wait([writing], timeout=10)
    lost = link.is_lost
    await until(lambda: tty_of(name) is None, 20)
    await ask(
        "device_add",
        driver="usb-serial",
        id="s3",
        chardev="c-s3",
        port="2.1",
        serial="SNs3",
        **{"always-plugged": True},
    )
    begin = time.monotonic()
    while time.monotonic() - begin < RETURN:
        try:
            (await port.open()).close()
        except DeviceError:
            await asyncio.sleep(0.2)
        else:
            break
    return {"ok": lost and tty_of(name) is not None, "back_s": time.monotonic() - begin}


async def replugged_while_wedged() -> dict[str, Any]:
    """Replug a deaf device while the kernel still closes its port; it opens again at once."""
    node = tty_of(by_id(GADGET))
    assert node is not None
    link = await SerialPort(node).open()
    while not link.is_lost:
        link.write(b"x" * 64)
        await asyncio.sleep(0.02)
    name = by_id(GADGET)
    await switch(name, on=False)
    await until(lambda: name not in read_tree(MACHINE.sysfs).devices, 20)
    hung = closing()
    await switch(name, on=True)
    port, begin = HubPort(place(name), MACHINE, Events()), time.monotonic()
    async with servo_controller():
        while True:
            try:
                (await port.open()).close()
                break
            except DeviceError:
                await asyncio.sleep(0.2)
        back = time.monotonic() - begin
    return {"ok": back < RETURN, "back_s": back, "hung": hung, "node": str(tty_of(name)), "before": str(node)}


async def port_power() -> dict[str, Any]:
    """Switch a port off and on by the kernel's attribute."""
    name = by_serial("SNs3")
    number = read_tree(MACHINE.sysfs).devices[name].devnum
    power = PortPower(PowerConfig(method=CycleMethod.PORT, off_time=1.0), MACHINE, Events())
    await power.cycle(name)
    back = await until(lambda: tty_of(name) is not None, RETURN)
    return {"ok": read_tree(MACHINE.sysfs).devices[name].devnum != number, "back_s": back}


OPENER = """
import os, sys
os.setgid(20); os.setuid(65534)
try:
    os.open(sys.argv[1], os.O_RDWR | os.O_NONBLOCK | os.O_NOCTTY)
except OSError as error:
    print(error.errno)
else:
    print(0)
"""


async def printed(*command: str) -> str:
    """Return the output of a program."""
    process = await asyncio.create_subprocess_exec(*command, stdout=asyncio.subprocess.PIPE)
    return (await process.communicate())[0].decode().strip()


async def tried(node: Path) -> str:
    """Return the error number when another user's program opens a node; 0 if it may."""
    return await printed(sys.executable, "-c", OPENER, str(node))


async def foreign_opener() -> dict[str, Any]:
    """A program without root rights that ignores locks, such as a modem manager, is refused."""
    node = tty_of(by_serial("SNs3"))
    assert node is not None
    Path(node).chmod(0o666)
    free = await tried(node)
    async with await SerialPort(node).open():
        found = await tried(node)
        try:
            await SerialPort(node).open()
            again = "opened"
        except PortBusyError:
            again = "busy"
    seen = (free, found, again)
    return {"ok": seen == ("0", "16", "busy"), "seen": seen}


def truck() -> TruckConfig:
    """Return a configuration with the ports of the machine."""
    chosen = {"drive": by_serial("SNs1"), "compass": by_serial("SNs2"), "imu": by_serial("SNs3")}
    chosen |= {"steering": by_id(GADGET), "lidar": "1-7"}
    devices = ""
    for role, name in chosen.items():
        driver = ", driver: { kind: wt61 }" if role == "imu" else ""
        devices += f'  {role}: {{ port: {{ hub: "{parent_of(name)}", port: {port_of(name)} }}{driver} }}\n'
    folder = Path("/run/truck")
    folder.mkdir(exist_ok=True)
    root = ROOT
    file = folder / "truck.yaml"
    file.write_text(f"include: {root}/configs/parts/chassis.yaml\nversion: 2\ndevices:\n{devices}\n")
    return load_config(file, TruckConfig)[0]


async def udev_rules() -> dict[str, Any]:
    """Check the rules of install-service: links by role, modem managers kept off, low-latency adapters."""
    Path("/run/udev/rules.d/70-monstertruckd.rules").write_text(rules_text(truck()))
    for command in (["control", "--reload"], ["trigger", "--action=add"], ["settle"]):
        await asyncio.to_thread(subprocess.run, ["udevadm", *command], check=True)
    links = {entry.name: str(entry.readlink()) for entry in Path("/dev/truck").iterdir()}
    node = tty_of(by_serial("SNs1"))
    shown = await printed("udevadm", "info", f"--name={node}")
    ok = set(links) == {"drive", "compass", "imu", "steering"} and Path("/dev", links["drive"]).name == node.name
    return {"ok": ok and "ID_MM_PORT_IGNORE=1" in shown, "links": links}


BRLTTY = """
SUBSYSTEM=="usb", KERNEL!="*:*", ENV{PRODUCT}=="403/6001/*", ENV{BRLTTY_BRAILLE_DRIVER}="hd"
"""
"""What such a rule of brltty's matches."""


async def brltty() -> dict[str, Any]:
    """A program claims an adapter as brltty does: driver and doctor report it; the rules keep brltty off."""
    name = by_serial("SNs3")
    device = read_tree(MACHINE.sysfs).devices[name]
    bus = int(name.partition("-")[0])
    line = os.open(f"/dev/bus/usb/{bus:03d}/{device.devnum:03d}", os.O_RDWR)
    claim = bytearray(struct.pack("II256s", 0, 0, b""))
    await asyncio.to_thread(fcntl.ioctl, line, USBDEVFS_DISCONNECT_CLAIM, claim)
    await until(lambda: tty_of(name) is None, 10)
    said = ""
    try:
        await HubPort(place(name), MACHINE, Events()).open()
    except DeviceError as error:
        said = str(error)
    seen = [found.seen for found in wiring(doctors_context()) if found.check == "imu"]
    await asyncio.to_thread(os.close, line)
    await switch(name, on=False)
    await switch(name, on=True)
    await until(lambda: tty_of(name) is not None, RETURN)
    Path("/run/udev/rules.d/85-brltty.rules").write_text(BRLTTY)
    for command in (["control", "--reload"], ["trigger", "--action=add"], ["settle"]):
        await asyncio.to_thread(subprocess.run, ["udevadm", *command], check=True)
    taken = "BRLTTY_BRAILLE_DRIVER" in await printed("udevadm", "info", f"/sys/bus/usb/devices/{name}")
    ok = "through usbfs" in said and any("through usbfs" in text for text in seen) and not taken
    return {"ok": ok, "said": said, "doctor": seen, "taken": taken}


def doctors_context() -> HostContext:
    """Return the input of a check of the doctor."""
    truck()
    return inspect(ROOT, Program.present(), Path("/run/truck/truck.yaml"), 0, CLOCK)


async def doctors_handshakes() -> dict[str, str]:
    """Return the reasons of the doctor's handshakes."""
    return {one.check: one.reason.value async for one in handshakes(doctors_context())}


async def topology() -> dict[str, Any]:
    """Names by topology lead to the same places, independently of the bus numbers."""
    names = {name: topology_of(MACHINE.sysfs, name) for name in read_tree(MACHINE.sysfs).devices if "-" in name}
    shown = await printed("udevadm", "info", f"/sys/bus/usb/devices/{by_serial('SNs1')}")
    ok = all(at_present(MACHINE.sysfs, long) == name for name, long in names.items())
    return {"ok": ok and f"ID_PATH={names[by_serial('SNs1')]}" in shown, "names": names}


async def renumbered_buses() -> dict[str, Any]:
    """Probe the controllers in another order: a port by topology opens on a bus with another number."""
    sysfs = MACHINE.sysfs
    before = by_serial("SNs1")
    topology = topology_of(sysfs, before)
    port = HubPort(place(topology), MACHINE, Events())
    link = await port.open()
    roots = [[*ancestors(name)][-1] for name in (before, by_id(JOYSTICK))]
    controllers = [str(sysfs.text(f"{DEVICES}/{root}/serial")) for root in roots]
    drivers = [*zip(("pci/drivers/xhci_hcd", "platform/drivers/dummy_hcd"), controllers, strict=True)]
    for driver, controller in drivers:
        await asyncio.to_thread(Path(f"/sys/bus/{driver}/unbind").write_text, controller)
    await until(lambda: link.is_lost, 20)
    for driver, controller in reversed(drivers):
        await asyncio.to_thread(Path(f"/sys/bus/{driver}/bind").write_text, controller)
    back = await until(lambda: tty_of(at_present(sysfs, topology)) is not None, RETURN)
    (await port.open()).close()
    after = by_serial("SNs1")
    ok = before != after == at_present(sysfs, topology) and before.partition("-")[2] == after.partition("-")[2]
    return {"ok": ok, "before": before, "after": after, "topology": topology, "back_s": back}


async def control() -> dict[str, Any]:
    """Sleep for 50 ms in a library call on the loop; the measurement must detect it."""
    master, slave = pty.openpty()
    with serial.Serial(os.ttyname(slave), timeout=0.05) as line:
        line.read(1)
    os.close(master)
    os.close(slave)
    return {"ok": True}


async def run_all() -> None:
    """Run one situation after the other."""
    acts = (control, tree, topology, open_and_close, udev_rules, foreign_opener, brltty, drivers, hub_pulled)
    acts += (unplugged_in_mid_write, port_power, deaf, listens_again, replugged_while_wedged, renumbered_buses)
    for act in acts:
        await situation(act.__name__, act)
