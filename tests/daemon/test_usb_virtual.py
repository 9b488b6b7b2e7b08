"""The whole daemon with every device on the two hubs of an emulated computer, on the virtual clock."""

from collections.abc import Awaitable, Callable
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from monstertruck_drivers.usb.config import UsbConfig
from monstertruck_runtime.clock import SECOND, VirtualClock, run_virtual
from monstertruck_runtime.mailbox import fifo, latest
from monstertruck_schemas import topics
from monstertruck_schemas.base import Message
from monstertruck_schemas.event import Event
from monstertruck_schemas.health import ServiceHealth, ServiceState
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.topics import Topic
from monstertruck_schemas.usb import UsbState
from monstertruckd.config.load import load_config
from monstertruckd.tools.simulation.config import SimulatedTruckConfig, with_overlay
from monstertruckd.tools.simulation.virtual_rig import VirtualRig

pytestmark = [pytest.mark.virtual, pytest.mark.timeout(120)]

FULL = Path(__file__).resolve().parents[2] / "configs" / "full.yaml"
BEHIND = {"1-1": ("drive", "steering", "compass", "stabiliser"), "1-2": ("lidar", "camera")}
SAMPLES: dict[str, Topic[Any]] = {
    "drive": topics.DRIVE,
    "steering": topics.STEERING,
    "compass": topics.COMPASS,
    "stabiliser": topics.STABILISER,
    "lidar": topics.SCAN,
    "camera": topics.CAMERA,
}
GAPS = {"lidar": 0.1, "camera": 1 / 15, "drive": 0.05, "steering": 0.05, "compass": 0.05, "stabiliser": 0.04}
"""Seconds between two samples of a healthy device."""


@cache
def config() -> SimulatedTruckConfig:
    whole = load_config(FULL, SimulatedTruckConfig)[0]
    return with_overlay(whole, {"recorder": None, "map": None, "tracker": None, "path": None})


class Robot:
    """A rig whose messages are kept."""

    def __init__(self, rig: VirtualRig) -> None:
        self.rig = rig
        self.clock = rig.clock
        self.usb = rig.computer.usb
        self._events = rig.bus.subscribe(topics.EVENT, fifo(4096))
        self._health = rig.bus.subscribe(topics.HEALTH, latest())
        self._samples = {role: rig.bus.subscribe(topic, fifo(4096)) for role, topic in SAMPLES.items()}
        self.tree = rig.bus.subscribe(topics.USB, latest())

    def services(self) -> dict[str, ServiceHealth]:
        assert self._health.latest is not None
        return {row.name: row for row in self._health.latest.services}

    def down(self) -> set[str]:
        return {row.name for row in self.services().values() if row.state is not ServiceState.READY}

    def events(self, *reasons: Reason) -> list[Event]:
        return [event for event in self._events.drain() if not reasons or event.reason in reasons]

    def samples(self, role: str) -> list[Message]:
        return self._samples[role].drain()

    async def ready(self, seconds: float = 10.0) -> float:
        """Seconds until every service is."""
        began = self.clock.now()
        while self._health.latest is None or self.down() or not set(SAMPLES) <= set(self.services()):
            assert self.clock.now() - began < seconds * SECOND, self.down()
            await self.clock.sleep(0.02)
        return (self.clock.now() - began) / SECOND


def play(scene: Callable[[Robot], Awaitable[None]], truck: SimulatedTruckConfig | None = None) -> None:
    async def main(clock: VirtualClock) -> None:
        rig = VirtualRig(truck or config(), clock)
        robot = Robot(rig)
        async with rig.running():
            await robot.ready()
            await scene(robot)

    run_virtual(main, start=SECOND)


def gaps(samples: list[Message]) -> float:
    """Longest time between two samples, s."""
    return float(np.diff([sample.stamp for sample in samples]).max()) / SECOND


@pytest.mark.parametrize("hub", BEHIND)
def test_a_hub_vanishes_and_returns(hub: str):
    others = next(roles for name, roles in BEHIND.items() if name != hub)

    async def scene(robot: Robot) -> None:
        await robot.clock.sleep(1.0)
        robot.events()
        for role in SAMPLES:
            robot.samples(role)
        robot.usb.lose_hub(hub)
        await robot.clock.sleep(1.5)
        assert robot.down() == set(BEHIND[hub])
        for role in BEHIND[hub]:
            row = robot.services()[role]
            assert row.state is ServiceState.STARTING
            assert row.detail == f"waits for hub {hub}"
        began = robot.clock.now()
        await robot.usb.return_hub(hub, robot.clock)
        await robot.ready(seconds=4.0)
        took = (robot.clock.now() - began) / SECOND
        print(f"hub {hub} with {len(BEHIND[hub])} devices: all back {took:.2f} s after its return began")
        assert took <= 4.0
        events = robot.events()
        lost = [event for event in events if event.reason is Reason.HUB_LOST]
        assert [event.values["devices"] for event in lost] == [len(BEHIND[hub])]
        assert [event.reason for event in events].count(Reason.HUB_RETURNED) == 1
        assert Reason.DEVICE_LOST not in {event.reason for event in events}, "the hub's loss says it all"
        await robot.clock.sleep(1.0)
        for role in others:
            samples = robot.samples(role)
            assert samples, role
            assert gaps(samples) < 1.5 * GAPS[role], role
            assert [s.seq for s in samples] == list(range(samples[0].seq, samples[0].seq + len(samples)))
        for role in BEHIND[hub]:
            assert robot.samples(role)[-1].stamp > robot.clock.now() - SECOND // 2, role
        nodes = {node.name: node for node in robot.tree.latest.nodes} if robot.tree.latest else {}
        assert nodes[hub].replugs == 1
        assert all(node.state is UsbState.PRESENT for node in nodes.values())

    play(scene)


def test_behind_a_returned_hub_interfaces_start_together_and_what_loads_it_apart():
    ready: dict[str, float] = {}

    async def scene(robot: Robot) -> None:
        for hub in BEHIND:
            robot.usb.lose_hub(hub)
            await robot.clock.sleep(1.0)
            robot.events()
            await robot.usb.return_hub(hub, robot.clock)
            back = robot.clock.now()
            await robot.ready()
            for event in robot.events(Reason.DEVICE_READY):
                ready[event.source] = (event.stamp - back) / SECOND

    play(scene)
    assert set(ready) == {role for roles in BEHIND.values() for role in roles}
    settle, stagger = UsbConfig().settle, UsbConfig().stagger
    assert max(ready[role] for role in BEHIND["1-1"]) < settle + 0.4
    assert ready["lidar"] < settle + 0.5
    assert ready["camera"] > settle + stagger


def test_two_adapters_of_one_kind_in_each_others_ports_are_refused_by_their_handshakes():
    async def scene(robot: Robot) -> None:
        def exchange() -> None:
            robot.usb.move("1-1.1", "1-1.7")
            robot.usb.move("1-1.4", "1-1.1")
            robot.usb.move("1-1.7", "1-1.4")

        exchange()
        await robot.clock.sleep(4.0)
        assert {"drive", "stabiliser"} <= robot.down()
        robot.samples("drive")
        await robot.clock.sleep(1.0)
        assert robot.samples("drive") == []
        exchange()
        assert await robot.ready() < 4.0

    play(scene)


def test_one_cable_pulled_is_no_lost_hub():
    async def scene(robot: Robot) -> None:
        robot.events()
        lidar = robot.rig.context.device("lidar")
        lidar.port.unplug()
        await robot.clock.sleep(1.0)
        assert robot.down() == {"lidar"}
        lidar.port.plug()
        assert await robot.ready() < 2.0
        reported = [event for event in robot.events() if event.reason in (Reason.HUB_LOST, Reason.DEVICE_LOST)]
        assert [(event.reason, event.source) for event in reported] == [(Reason.DEVICE_LOST, "lidar")]

    play(scene)


def test_link_host_and_converter_are_read_from_the_emulated_computer():
    overlay = {
        "devices": {"steering": {"driver": {"battery": None}}},
        "monitors": {"battery": {"kind": "iio"}},
    }

    async def scene(robot: Robot) -> None:
        bus = robot.rig.bus
        boxes = [bus.subscribe(topic, latest()) for topic in (topics.BATTERY, topics.LINK, topics.HOST)]
        await robot.clock.sleep(2.5)
        battery, link, host = (box.latest for box in boxes)
        assert battery is not None
        assert link is not None
        assert host is not None
        volts = robot.rig.world.truth(robot.clock.now()).supply_v
        assert battery.voltage == pytest.approx(volts, abs=0.1)
        assert link.interface == "wlan0"
        assert host.cores == 4
        robot.rig.robot.monitored["link"].inject("wifi", "off")
        robot.rig.robot.monitored["host"].inject("temperature", "90")
        robot.events()
        await robot.clock.sleep(6.0)
        assert {Reason.LINK_DOWN, Reason.HOST_HOT} <= {event.reason for event in robot.events()}
        assert robot.down() == set()

    play(scene, with_overlay(config(), overlay))


def test_a_camera_sees_the_world_and_comes_back():
    async def scene(robot: Robot) -> None:
        pictures = robot.rig.bus.subscribe(topics.CAMERA, fifo(64))
        await robot.clock.sleep(1.0)
        taken = pictures.drain()
        assert 14 <= len(taken) <= 16
        assert all(picture.data.startswith(b"\xff\xd8") and picture.data.endswith(b"\xff\xd9") for picture in taken)
        robot.rig.context.device("camera").command(["vanish", "0.5"])
        await robot.clock.sleep(0.3)
        assert "camera" in robot.down()
        await robot.ready()

    play(scene)
