"""Handshakes with emulated devices, and none while a daemon has them."""

import asyncio
from collections.abc import Callable
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from unittest.mock import AsyncMock, Mock

import pytest

from monstertruck_drivers.cable import MemoryPort, SocketPort
from monstertruck_drivers.computer import Computer
from monstertruck_drivers.config import PortConfig, TcpPortConfig
from monstertruck_drivers.hokuyo_urg.lx_emulator import LxEmulator
from monstertruck_drivers.hokuyo_urg.models import LX
from monstertruck_runtime.clock import VirtualClock, WallClock, run_virtual
from monstertruck_runtime.errors import DeviceError, DeviceWedgedError, PortBusyError
from monstertruck_runtime.threads import inline
from monstertruck_schemas.reasons import Reason
from monstertruck_sim.computer import EmulatedComputer
from monstertruck_sim.robot import SimulatedRobot
from monstertruckd.config.load import load_config, load_truck
from monstertruckd.tools.doctor import devices as module
from monstertruckd.tools.doctor.context import Finding, HostContext, Level
from monstertruckd.tools.doctor.devices import handshakes, wiring
from monstertruckd.tools.simulation.config import SimulatedTruckConfig
from tests.unit.drivers.scanning.kit import Room
from tests.unit.tools.doctor.kit import EmulatedHost, see
from tests.unit.tools.install.kit import PROGRAM, ROOT, TRUCK

FULL = ROOT / "configs" / "full.yaml"


class Truck:
    """All emulated devices of the full truck, each behind its port of the emulated computer."""

    def __init__(self, folder: Path, clock: VirtualClock) -> None:
        self.config = load_config(FULL, SimulatedTruckConfig)[0]
        self.ports = {role: MemoryPort(role) for role in self.config.devices.present()}
        self.computer = EmulatedComputer(folder, self.config.devices, self.ports, clock)
        self.robot = SimulatedRobot(
            self.config.sim,
            self.config.devices,
            self.config.monitors,
            clock,
            self.computer.ports,
            self.computer.folder,
            offload=inline,
        )


def shake(folder: Path, change: Callable[[Truck], None] = lambda _: None) -> dict[str, Finding]:
    """Ask all devices but the camera, whose node only a kernel could open."""

    async def main(clock: VirtualClock) -> dict[str, Finding]:
        truck = Truck(folder, clock)
        around = asyncio.create_task(truck.robot.run())
        await clock.sleep(1.0)
        change(truck)
        blind = truck.config.model_copy(update={"devices": truck.config.devices.model_copy(update={"camera": None})})
        context = HostContext(folder, truck.computer.computer(), PROGRAM, FULL, blind, None, None)
        found = {finding.check: finding async for finding in handshakes(context)}
        around.cancel()
        await asyncio.wait([around])
        return found

    return run_virtual(main)


def test_every_device_answers(tmp_path: Path):
    found = shake(tmp_path)
    assert {finding.level for finding in found.values()} == {Level.OK}
    assert sorted(name.split()[0] for name in found) == ["compass", "drive", "lidar", "stabiliser", "steering"]
    assert found["lidar handshake"].seen == "Hokuyo URG-04LX laser scanner (SCIP 1.1 and 2.0) answers"


def test_silence_and_absence(tmp_path: Path):
    def change(truck: Truck) -> None:
        truck.ports["drive"].device.faults.deaf = True
        truck.computer.usb.unplug("1-2.1")

    found = shake(tmp_path, change)
    assert found["drive handshake"].reason is Reason.DEVICE_TIMEOUT
    assert found["drive handshake"].fix is not None
    assert " -m monstertruckd probe drive --port " in found["drive handshake"].fix
    assert "lidar handshake" not in found, "the wiring tells of it"


@pytest.mark.parametrize(
    "words",
    [
        ("/opt/truck/.venv/bin/python", "-P", "-m", "monstertruckd", "run", "--config", "x"),
        ("/usr/bin/python3", "/usr/local/bin/monstertruckd", "run", "-c", "x"),
    ],
)
def test_nothing_is_asked_while_a_daemon_runs(words: tuple[str, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    async def never(*_: object) -> Finding:
        raise AssertionError("a port of the daemon was touched")

    monkeypatch.setattr(module, "_handshake", never)
    (found,) = see(tmp_path, handshakes, lambda emulated: emulated.process(4711, *words)).values()
    assert found.level is Level.OK
    assert found.seen == "not tested: the running daemon (process 4711) uses the ports"
    assert found.fix == "/opt/monstertruckd/.venv/bin/python -m monstertruckd status --once"


def test_other_processes_are_no_daemon(tmp_path: Path):
    def others(emulated: EmulatedHost) -> None:
        emulated.process(1, "/sbin/init")
        emulated.process(2, "python", "-m", "monstertruckd", "doctor")
        emulated.put("proc/3/cmdline")

    def check(context: HostContext) -> list[Finding]:
        assert context.daemon() is None
        return []

    see(tmp_path, check, others)


@pytest.mark.parametrize(
    ("error", "fix"),
    [
        (PortBusyError("held: held by another process"), "sudo fuser -v "),
        (DeviceWedgedError("held: does not open"), "/opt/monstertruckd/.venv/bin/python -m monstertruckd probe"),
    ],
)
def test_a_port_that_another_program_holds_or_that_is_wedged(error: DeviceError, fix: str, tmp_path: Path):
    class Held:
        name = "held"

        async def open(self) -> None:
            raise error

    def held(emulated: EmulatedHost) -> None:
        machine = replace(emulated.context.computer.machine, serial=lambda *_, **__: Held())
        assert emulated.context.config is not None
        devices = emulated.context.config.devices
        only = devices.model_copy(update=dict.fromkeys(set(devices.present()) - {"steering"}))
        config = emulated.context.config.model_copy(update={"devices": only})
        computer = replace(emulated.context.computer, machine=machine)
        emulated.context = replace(emulated.context, config=config, computer=computer)

    (found,) = see(tmp_path, handshakes, held).values()
    assert found.reason is error.reason
    assert found.seen == str(error)
    assert found.fix is not None
    assert found.fix.startswith(fix)


async def test_a_port_is_probed_with_the_control_lines_of_its_settings():
    """An RPLIDAR's motor stops while DTR is raised."""
    serial, node = Mock(), Path("/dev/ttyUSB0")
    context = Mock(computer=Mock(machine=Mock(serial=serial)))
    kind = Mock(opens="serial", identify=AsyncMock())
    device = Mock(port=PortConfig(path=node, baud=9600, dtr=False, rts=False))
    await module._identify(context, "lidar", device, kind, str(node))
    serial.assert_called_once_with(node, 9600, dtr=False, rts=False, framing="8N1")


async def test_a_sensor_on_the_network_is_asked_at_its_address(tmp_path: Path):
    clock = WallClock()
    with closing(SocketPort("127.0.0.1", 0)) as cable:
        port = TcpPortConfig(address=cable.address[0], tcp=cable.address[1])
        config = load_truck(TRUCK)[0]
        lidar = {"port": port.model_dump(), "driver": {"kind": "hokuyo_lx"}}
        config = type(config).model_validate({"version": 2, "devices": {"lidar": lidar}}, strict=False)
        emulator = LxEmulator(clock, Room(), LX["ust_10lx"])
        serving = asyncio.create_task(emulator.run(cable.device))
        await asyncio.sleep(0)
        computer = Computer.at(tmp_path, clock)
        context = HostContext(tmp_path, computer, PROGRAM, TRUCK, config, None, None)
        assert [(found.level, found.seen) for found in wiring(context)] == [
            (Level.OK, f"at {port.label} on the network")
        ]
        cable.plug()
        (answers,) = [finding async for finding in handshakes(context)]
        serving.cancel()
        await asyncio.wait([serving])
    (silent,) = [finding async for finding in handshakes(context)]
    assert (answers.level, answers.check) == (Level.OK, "lidar handshake")
    assert silent.reason is Reason.DEVICE_LOST
    assert silent.fix is not None
    assert silent.fix.endswith(f"probe lidar --port {port.label}")
