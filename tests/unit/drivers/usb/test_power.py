"""Ports are switched by the way that is configured, never too often, and never a hub's."""

import sys
from pathlib import Path

import pytest
from pydantic import ValidationError

from monstertruck_drivers.computer import run_command
from monstertruck_drivers.usb.config import CycleMethod, PowerConfig, UsbConfig
from monstertruck_drivers.usb.tree import port_directory
from monstertruck_runtime.clock import SECOND
from monstertruck_runtime.errors import BusyError, DeviceError
from monstertruck_schemas.event import Severity
from monstertruck_schemas.reasons import Reason
from tests.unit.drivers.usb.rig import Bench, play


def by(method: CycleMethod | None) -> UsbConfig:
    return UsbConfig(power=PowerConfig(method=method))


@pytest.mark.parametrize("method", CycleMethod)
def test_the_device_vanishes_and_comes_back(tmp_path: Path, method: CycleMethod):
    async def scene(bench: Bench) -> None:
        link = await bench.ports["lidar"].open()
        await bench.power.cycle("1-1.1")
        assert link.is_lost
        await bench.clock.sleep(1)
        (await bench.ports["lidar"].open()).close()

    bench = play(tmp_path, scene, by(method))
    [(severity, _, text, values)] = bench.events.of(Reason.PORT_CYCLED)
    assert severity is Severity.WARNING
    assert "hub 1-1 port 1" in text
    assert values == {"method": method.value}
    commands = [["uhubctl", "-l", "1-1", "-p", "1", "-a", action] for action in ("off", "on")]
    assert bench.usb.commands == (commands if method is CycleMethod.UHUBCTL else [])


@pytest.mark.parametrize("method", [CycleMethod.PORT, CycleMethod.UHUBCTL])
def test_a_port_that_is_switched_off_stays_off_until_it_is_cycled(tmp_path: Path, method: CycleMethod):
    async def scene(bench: Bench) -> None:
        link = await bench.ports["lidar"].open()
        await bench.power.switch_off("1-1.1")
        await bench.clock.sleep(30)
        assert link.is_lost
        assert not bench.usb.present("1-1.1")
        await bench.power.cycle("1-1.1")
        assert bench.usb.present("1-1.1")

    bench = play(tmp_path, scene, by(method))
    [(severity, _, text, _)] = bench.events.of(Reason.PORT_OFF)
    assert severity is Severity.WARNING
    assert "hub 1-1 port 1" in text


@pytest.mark.parametrize("method", [None, CycleMethod.AUTHORIZED])
def test_only_a_way_that_switches_power_can_cut_a_port(method: CycleMethod | None):
    with pytest.raises(ValidationError, match="cut: expected method port or uhubctl"):
        PowerConfig(method=method, cut=("drive",))


def test_power_stays_off_for_its_time_and_comes_back_when_cancelled(tmp_path: Path):
    async def scene(bench: Bench) -> None:
        attribute = f"{port_directory('1-1.1')}/disable"
        with pytest.raises(TimeoutError):
            async with bench.clock.deadline(1):
                await bench.power.cycle("1-1.1")
        assert bench.usb.sysfs.text(attribute) == "0"
        assert bench.usb.present("1-1.1")
        await bench.clock.sleep(2)
        start = bench.clock.now()
        await bench.power.cycle("1-1.1")
        assert (bench.clock.now() - start) / SECOND == pytest.approx(2)

    play(tmp_path, scene, by(CycleMethod.PORT))


def test_uhubctl_leaves_no_port_without_power_when_cancelled(tmp_path: Path):
    async def scene(bench: Bench) -> None:
        with pytest.raises(TimeoutError):
            async with bench.clock.deadline(1):
                await bench.power.cycle("1-1.1")
        assert bench.usb.present("1-1.1")
        assert [command[-1] for command in bench.usb.commands] == ["off", "on"]

    play(tmp_path, scene, by(CycleMethod.UHUBCTL))


def test_cycles_of_one_port_become_rarer(tmp_path: Path):
    async def scene(bench: Bench) -> None:
        await bench.power.cycle("1-1.1")
        for pause in (1, 2, 4, 8, 16, 32, 60, 60):
            with pytest.raises(BusyError, match="again in"):
                await bench.power.cycle("1-1.1")
            await bench.clock.sleep(pause - 0.6)
            with pytest.raises(BusyError):
                await bench.power.cycle("1-1.1")
            await bench.clock.sleep(0.2)
            await bench.power.cycle("1-1.1")
        await bench.power.cycle("1-1.2")
        await bench.clock.sleep(601)
        await bench.power.cycle("1-1.1")
        await bench.clock.sleep(0.6)
        await bench.power.cycle("1-1.1")

    play(tmp_path, scene, by(CycleMethod.AUTHORIZED))


def test_hubs_are_never_switched(tmp_path: Path):
    async def scene(bench: Bench) -> None:
        for name in ("1-1", "usb1"):
            with pytest.raises(DeviceError, match="is a hub"):
                await bench.power.cycle(name)

    assert play(tmp_path, scene, by(CycleMethod.PORT)).events.kept == []


def test_nothing_is_switched_unless_configured(tmp_path: Path):
    async def scene(bench: Bench) -> None:
        with pytest.raises(DeviceError, match=r"power\.method"):
            await bench.power.cycle("1-1.1")

    play(tmp_path, scene, by(None))
    with pytest.raises(ValidationError, match="needs a method"):
        PowerConfig(after=3)


@pytest.mark.parametrize(
    ("method", "refused"),
    [(CycleMethod.PORT, "disable"), (CycleMethod.AUTHORIZED, "authorized"), (CycleMethod.UHUBCTL, "uhubctl")],
)
def test_what_the_machine_refuses_is_said(tmp_path: Path, method: CycleMethod, refused: str):
    async def scene(bench: Bench) -> None:
        bench.usb.refused.add(refused)
        with pytest.raises(DeviceError, match=f"hub 1-1 port 1 cannot be switched by '{method.value}'"):
            await bench.power.cycle("1-1.1")

    assert play(tmp_path, scene, by(method)).events.kept == []


def test_a_failing_uhubctl_is_said(tmp_path: Path):
    async def scene(bench: Bench) -> None:
        with pytest.raises(DeviceError, match="uhubctl failed with 1: No compatible devices"):
            await bench.power.cycle("1-1.9")

    play(tmp_path, scene, by(CycleMethod.UHUBCTL))


async def test_programs_run_without_a_shell():
    code, output = await run_command([sys.executable, "-c", "import sys; print(sys.argv[1]); sys.exit(3)", "$HOME;ls"])
    assert (code, output) == (3, "$HOME;ls")
    with pytest.raises(FileNotFoundError):
        await run_command(["no-such-program-here"])


@pytest.mark.parametrize("cut", [False, True])
def test_both_halves_of_a_usb_3_hub_are_switched(tmp_path: Path, cut: bool):
    """The port of one half alone leaves the power on."""
    written: list[tuple[str, str]] = []

    async def scene(bench: Bench) -> None:
        sysfs = bench.machine.sysfs
        peer = sysfs.root / port_directory("1-1.1") / "peer"
        peer.mkdir()
        (peer / "disable").write_text("0\n")
        really = sysfs.write

        def write(path: str, text: str) -> None:
            written.append((path.removeprefix(port_directory("1-1.1")), text))
            really(path, text)

        sysfs.write = write  # type: ignore[method-assign]
        await (bench.power.switch_off("1-1.1") if cut else bench.power.cycle("1-1.1"))

    play(tmp_path, scene, by(CycleMethod.PORT))
    off = [("/disable", "1"), ("/peer/disable", "1")]
    assert written == (off if cut else [*off, ("/disable", "0"), ("/peer/disable", "0")])
