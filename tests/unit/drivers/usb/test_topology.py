"""Places by topology keep their names when the kernel numbers its buses in another order."""

import asyncio
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from monstertruck_drivers.cable import MemoryPort
from monstertruck_drivers.computer import Sysfs
from monstertruck_drivers.usb.config import CycleMethod, PowerConfig, UsbConfig, UsbPortConfig
from monstertruck_drivers.usb.tree import (
    DEVICES,
    ancestors,
    at_present,
    device_name,
    parent_of,
    place,
    port_of,
    renumbered,
    topology_of,
)
from monstertruck_runtime.clock import SECOND
from monstertruck_runtime.errors import BusyError
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.usb import UsbState
from tests.unit.drivers.usb.rig import BY_TOPOLOGY, PORTS, Bench, play

BOARD, CARD = "pci-0000:00:14.0", "platform-fd500000.pcie-pci-0000:01:00.0"


def booted(folder: Path, *controllers: str) -> Sysfs:
    """Each controller with its two buses, in the order in which they were found; a hub at port 1 of the USB 2 ones."""
    for index, controller in enumerate(controllers):
        for half, speed in enumerate(("480", "5000")):
            root = folder / DEVICES / f"usb{2 * index + half + 1}"
            root.mkdir(parents=True)
            for name, text in (("serial", controller), ("speed", speed), ("devnum", "1")):
                (root / name).write_text(f"{text}\n")
        hub = folder / DEVICES / f"{2 * index + 1}-1"
        hub.mkdir()
        (hub / "devnum").write_text("2\n")
    return Sysfs(folder)


def test_names_are_cut_and_joined():
    hub = f"{BOARD}-usb-0:1"
    assert device_name(hub, 4) == f"{BOARD}-usb-0:1.4"
    assert device_name(f"{BOARD}-usb-0:0", 4) == f"{BOARD}-usb-0:4"
    assert parent_of(f"{BOARD}-usb-0:1.4") == hub
    assert parent_of(hub) == f"{BOARD}-usb-0:0"
    assert parent_of(f"{BOARD}-usb-0:0") is None
    assert port_of(f"{BOARD}-usb-0:1.4") == 4
    assert port_of(hub) == 1
    assert list(ancestors(f"{BOARD}-usb-0:1.4")) == [hub, f"{BOARD}-usb-0:0"]
    assert place(f"{BOARD}-usb-0:1.4") == f"hub {hub} port 4"


def test_a_place_is_found_whatever_the_order_of_the_controllers(tmp_path: Path):
    first = booted(tmp_path / "first", "0000:00:14.0", "0000:01:00.0")
    second = booted(tmp_path / "second", "0000:01:00.0", "0000:00:14.0")
    wanted = UsbPortConfig(hub=f"{BOARD}-usb-0:1", port=2)
    assert wanted.at_present(first).device == "1-1.2"
    assert wanted.at_present(second).device == "3-1.2"
    assert at_present(second, f"{CARD}-usb-0:1.2") == "1-1.2", "what stands before the controller does not matter"
    assert at_present(second, f"{BOARD}-usb-0:0") == "usb3"


def test_a_place_on_the_usb_3_half_is_found_where_something_is_there(tmp_path: Path):
    sysfs = booted(tmp_path, "0000:00:14.0")
    camera = tmp_path / DEVICES / "2-3"
    camera.mkdir()
    (camera / "devnum").write_text("2\n")
    assert at_present(sysfs, f"{BOARD}-usb-0:3") == "2-3"
    assert at_present(sysfs, f"{BOARD}-usb-0:2") == "1-2"


def test_a_controller_that_is_not_there_leaves_the_name(tmp_path: Path):
    port = UsbPortConfig(hub=f"{CARD}-usb-0:1", port=2)
    assert port.at_present(booted(tmp_path, "0000:00:14.0")) is port


def test_names_lead_there_and_back(tmp_path: Path):
    sysfs = booted(tmp_path, "xhci-hcd.1.auto", "0000:00:14.0")
    for name, topology in (
        ("3-1.2", f"{BOARD}-usb-0:1.2"),
        ("usb3", f"{BOARD}-usb-0:0"),
        ("1-1", "platform-xhci-hcd.1.auto-usb-0:1"),
    ):
        assert topology_of(sysfs, name) == topology
        assert at_present(sysfs, topology) == name
    assert topology_of(sysfs, "7-1") == "7-1", "no such bus"


@pytest.mark.parametrize("hub", ["pci-0000:00:14.0", "usb-0:1", "pci-0-usb-0:", 'a"b-usb-0:1', "a b-usb-0:1"])
def test_other_names_are_refused(hub: str):
    with pytest.raises(ValidationError):
        UsbPortConfig(hub=hub, port=1)


# While the robot runs

OTHER = "0000:01:00.0"
"""Controller of bus 2, with one device behind it."""


def add_other(bench: Bench) -> None:
    bench.usb.controllers[2] = OTHER
    bench.usb.add_device("2-1", "0403:6001", "stranger", node="ttyUSB", cable=MemoryPort("stranger"))


def all_ready(starts: dict[str, list[float]], since: float) -> bool:
    return all(times and times[-1] > since for times in starts.values())


@pytest.mark.parametrize("deaf", [False, True])
@pytest.mark.parametrize("buses", [{"1": "3"}, {"1": "2", "2": "1"}, {"1": "11", "2": "1"}], ids=str)
def test_devices_are_found_again_after_their_bus_got_another_number(tmp_path: Path, buses: dict[str, str], deaf: bool):
    async def scene(bench: Bench) -> None:
        add_other(bench)
        bench.usb.watcher.deaf = deaf
        async with bench.drivers() as starts:
            await bench.clock.sleep(2.0)
            bench.usb.renumber(buses)
            began = bench.clock.now() / SECOND
            assert not bench.usb.present("1-1.3")
            await bench.clock.sleep(4.0)
            assert all_ready(starts, began), starts
            await bench.clock.sleep(bench.config.rescan)
            assert {role: len(times) for role, times in starts.items()} == dict.fromkeys(starts, 2)
        for reason in (Reason.HUB_LOST, Reason.HUB_RETURNED):
            (event,) = (one for one in bench.events.of(reason) if one[3]["devices"] > 1)
            assert event[3]["hub"] == f"usb{buses['1']}"
        assert bench.node(f"{buses['1']}-1.3").role == "drive"
        assert bench.node(f"{buses['1']}-1.3").replugs == 1
        assert {node.state for node in bench.out.kept[-1].nodes} == {UsbState.PRESENT}, "no place of before is left"

    play(tmp_path, scene, places=BY_TOPOLOGY)


def test_a_controller_that_is_there_only_after_the_start_is_found(tmp_path: Path):
    async def scene(bench: Bench) -> None:
        bench.usb.unplug("usb1")
        await bench.clock.sleep(1.0)
        async with bench.drivers() as starts:
            await bench.clock.sleep(2.0)
            assert not any(starts.values())
            assert {role: bench.hubs.waits_for(role) for role in starts} == dict.fromkeys(starts)
            began = bench.clock.now() / SECOND
            for name in ("usb1", "1-1", "1-2", "1-1.1", "1-1.2", "1-1.3", "1-1.4", "1-2.1"):
                bench.usb.plug(name)
            await bench.clock.sleep(4.0)
            assert all_ready(starts, began), starts

    play(tmp_path, scene, places=BY_TOPOLOGY)


@pytest.mark.parametrize("act", ["cycle", "switch_off"])
def test_the_port_that_is_switched_is_the_one_where_the_device_is_now(tmp_path: Path, act: str):
    async def scene(bench: Bench) -> None:
        bench.usb.renumber({"1": "4"})
        switching = asyncio.create_task(getattr(bench.power, act)(BY_TOPOLOGY["drive"].device))
        await bench.clock.sleep(0.5)
        assert not bench.usb.present("4-1.3")
        assert bench.usb.present("4-1.2")
        await switching
        assert bench.usb.present("4-1.3") == (act == "cycle")

    by_port = UsbConfig(power=PowerConfig(method=CycleMethod.PORT))
    play(tmp_path, scene, by_port, BY_TOPOLOGY, watched=False)


def test_a_port_is_not_switched_sooner_because_its_bus_got_another_number(tmp_path: Path):
    async def scene(bench: Bench) -> None:
        port = BY_TOPOLOGY["drive"].device
        await bench.power.cycle(port)
        bench.usb.renumber({"1": "4"})
        for name in (port, "4-1.3"):
            with pytest.raises(BusyError, match="hub 4-1 port 3 was switched moments ago"):
                await bench.power.cycle(name)

    play(tmp_path, scene, UsbConfig(power=PowerConfig(method=CycleMethod.AUTHORIZED)), places=BY_TOPOLOGY)


def test_a_bus_number_that_another_controller_had_keeps_nothing_of_it(tmp_path: Path):
    """The one whose number was taken comes back later, with a third number."""

    async def scene(bench: Bench) -> None:
        add_other(bench)
        await bench.clock.sleep(1.0)
        bench.usb.unplug("usb2")
        await bench.clock.sleep(1.0)
        bench.usb.renumber({"1": "2", "2": "5"})
        await bench.clock.sleep(4.0)
        bench.usb.plug("usb5")
        bench.usb.plug("5-1")
        await bench.clock.sleep(4.0)
        roles = {node.name: node.role for node in bench.out.kept[-1].nodes if node.role is not None}
        assert roles == {f"2-{port.hub[2:]}.{port.port}": role for role, port in PORTS.items()}
        assert {node.state for node in bench.out.kept[-1].nodes} == {UsbState.PRESENT}

    play(tmp_path, scene, places=BY_TOPOLOGY)


@given(st.permutations(range(1, 6)), st.integers(1, 7), st.integers(0, 6))
def test_names_after_buses_got_other_numbers_lead_back(numbers: list[int], bus: int, port: int):
    buses = {str(before): str(after) for before, after in enumerate(numbers, 1)}
    name = f"{bus}-{port}.{bus}" if port else f"usb{bus}"
    back = {after: before for before, after in buses.items()}
    assert renumbered(renumbered(name, buses), back) == name
    assert renumbered(name, buses) == name.replace(str(bus), buses.get(str(bus), str(bus)), 1)
