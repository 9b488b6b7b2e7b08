"""Losses are grouped by hub, and what comes back starts in order of safety, spaced apart."""

import asyncio
import contextlib
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest

from monstertruck_drivers.usb.config import UsbConfig
from monstertruck_drivers.usb.tree import DEVICES
from monstertruck_runtime.clock import SECOND
from monstertruck_runtime.ports import Ready
from monstertruck_runtime.service import RestartPolicy, supervise
from monstertruck_schemas.event import Severity
from monstertruck_schemas.health import ServiceHealth, ServiceState
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.usb import UsbState
from tests.unit.drivers.usb.rig import PORTS, Bench, play

pytestmark = pytest.mark.virtual

FIRST = ("lidar", "steering", "drive", "stabiliser")
"""Roles behind hub 1-1."""


def test_at_rest_nobody_waits_and_nothing_is_reported(tmp_path: Path):
    async def scene(bench: Bench) -> None:
        async with bench.drivers() as starts:
            await bench.clock.sleep(20)
            assert all(len(times) == 1 for times in starts.values())
            assert max(times[0] for times in starts.values()) < 1.2, "all at once: no hub came back"
            assert bench.hubs.waiting == frozenset()

    bench = play(tmp_path, scene)
    assert bench.events.kept == []
    assert len(bench.out.kept) == pytest.approx(21, abs=3), "once a second"


def assert_apart(starts: Mapping[str, float]) -> None:
    """Interfaces start together, the lidar apart from them, in order of safety."""
    assert starts["drive"] == pytest.approx(starts["steering"])
    assert starts["lidar"] >= starts["drive"] + 0.3 - 1e-6
    assert starts["stabiliser"] == pytest.approx(starts["lidar"])


@pytest.mark.parametrize("deaf", [False, True], ids=["udev", "no udev"])
def test_a_hub_with_four_devices_vanishes_and_returns(tmp_path: Path, deaf: bool):
    async def scene(bench: Bench) -> None:
        bench.usb.watcher.deaf = deaf
        async with bench.drivers() as starts:
            await bench.clock.sleep(3)
            bench.usb.lose_hub("1-1")
            await bench.clock.sleep(2)
            assert bench.hubs.waiting == set(FIRST)
            assert bench.states()["1-1.1"] is UsbState.WAITING
            assert bench.node("1-1.1").tty is None
            assert bench.hubs.waits_for("drive") == "waits for hub 1-1"
            assert bench.hubs.waits_for("compass") is None
            returned = bench.clock.now() / SECOND
            await bench.usb.return_hub("1-1", bench.clock)
            await bench.clock.sleep(8)
            restarts = {role: times[1] - returned for role, times in starts.items() if len(times) > 1}
            assert sorted(restarts) == sorted(FIRST)
            assert_apart(restarts)
            assert max(restarts.values()) < 2, "everything is back within 2 s"
            assert len(starts["compass"]) == 1, "the other hub's device never noticed"
            assert bench.hubs.waiting == frozenset()

    bench = play(tmp_path, scene)
    assert bench.events.reasons == [Reason.HUB_LOST, Reason.HUB_RETURNED]
    [(severity, source, text, values)] = bench.events.of(Reason.HUB_LOST)
    assert (severity, source) == (Severity.WARNING, "usb")
    assert values == {"hub": "1-1", "devices": 4, "roles": "lidar,steering,drive,stabiliser"}
    assert all(role in text for role in FIRST)
    [(severity, _, text, values)] = bench.events.of(Reason.HUB_RETURNED)
    assert severity is Severity.INFO
    assert (values["devices"], values["missing"]) == (4, 0)
    assert 2 < values["seconds"] < 5
    assert [bench.node(PORTS[role].device).replugs for role in FIRST] == [1, 1, 1, 1]
    assert bench.node("1-2.1").replugs == 0


def test_no_udev_a_missed_device_is_looked_for_at_once(tmp_path: Path):
    async def scene(bench: Bench) -> None:
        bench.usb.watcher.deaf = True
        async with bench.drivers():
            await bench.clock.sleep(1)
            bench.usb.lose_hub("1-1")
            await bench.clock.sleep(0.6)
            assert bench.events.reasons == [Reason.HUB_LOST], "long before the next rescan"

    play(tmp_path, scene, UsbConfig(rescan=60.0))


def test_waiting_devices_are_not_retried(tmp_path: Path):
    async def scene(bench: Bench) -> None:
        bench.usb.lose_hub("1-1")
        await bench.clock.sleep(0.1)
        opening = asyncio.create_task(bench.ports["lidar"].open())
        await bench.clock.sleep(60)
        assert not opening.done(), "it neither fails nor counts a restart: it waits"
        await bench.usb.return_hub("1-1", bench.clock)
        link = await opening
        link.close()

    play(tmp_path, scene)


def test_an_outage_costs_a_supervised_driver_one_restart(tmp_path: Path):
    class Driver:
        name = "lidar"

        def __init__(self, bench: Bench) -> None:
            self._port = bench.ports["lidar"]

        async def run(self, ready: Ready) -> None:
            async with await self._port.open() as link:
                ready()
                await link.read()

    rows: list[ServiceHealth] = []

    async def scene(bench: Bench) -> None:
        rng = np.random.default_rng(0)
        task = asyncio.create_task(supervise(Driver(bench), RestartPolicy(), bench.clock, rows.append, rng))
        await bench.clock.sleep(1)
        bench.usb.lose_hub("1-1")
        await bench.clock.sleep(300)
        assert (rows[-1].state, rows[-1].restarts) == (ServiceState.STARTING, 1)
        await bench.usb.return_hub("1-1", bench.clock)
        await bench.clock.sleep(3)
        assert (rows[-1].state, rows[-1].restarts) == (ServiceState.READY, 1)
        task.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await task

    play(tmp_path, scene)


def test_one_cable_pulled_is_no_hub_event(tmp_path: Path):
    async def scene(bench: Bench) -> None:
        async with bench.drivers() as starts:
            bench.usb.unplug("1-1.1")
            await bench.clock.sleep(1)
            assert bench.states()["1-1.1"] is UsbState.ABSENT
            assert bench.hubs.waiting == frozenset()
            bench.usb.plug("1-1.1")
            await bench.clock.sleep(1)
            assert [len(starts[role]) for role in FIRST] == [2, 1, 1, 1]

    bench = play(tmp_path, scene)
    assert bench.events.kept == []
    assert bench.node("1-1.1").replugs == 1


def test_a_quick_replug_of_one_device_counts(tmp_path: Path):
    async def scene(bench: Bench) -> None:
        bench.usb.unplug("1-1.3")
        bench.usb.plug("1-1.3")
        await bench.clock.sleep(1)
        assert bench.hubs.waiting == frozenset()

    bench = play(tmp_path, scene)
    assert bench.node("1-1.3").replugs == 1
    assert bench.events.kept == []


def test_a_hub_that_stays_but_loses_all_devices_is_one_event(tmp_path: Path):
    async def scene(bench: Bench) -> None:
        for name in ("1-1.1", "1-1.3", "1-1.4", "1-1.2"):  # one after the other, as power sags
            bench.usb.unplug(name)
            await bench.clock.sleep(0.06)
        await bench.clock.sleep(1)
        assert bench.hubs.waiting == set(FIRST)
        for name in ("1-1.1", "1-1.3", "1-1.4", "1-1.2"):
            bench.usb.plug(name)
        await bench.clock.sleep(3)

    bench = play(tmp_path, scene)
    assert bench.events.reasons == [Reason.HUB_LOST, Reason.HUB_RETURNED]
    assert "all devices behind it disappeared" in bench.events.of(Reason.HUB_LOST)[0][2]


def test_the_only_device_of_a_hub_is_not_the_hub(tmp_path: Path):
    async def scene(bench: Bench) -> None:
        bench.usb.unplug("1-2.2")
        await bench.clock.sleep(1)
        bench.usb.unplug("1-2.1")
        await bench.clock.sleep(1)
        assert bench.hubs.waiting == frozenset()

    assert play(tmp_path, scene).events.kept == []


def test_a_hub_with_one_device_is_a_hub(tmp_path: Path):
    async def scene(bench: Bench) -> None:
        bench.usb.unplug("1-2.2")
        await bench.clock.sleep(1)
        bench.usb.lose_hub("1-2")
        await bench.clock.sleep(1)
        assert bench.hubs.waiting == {"compass"}

    assert play(tmp_path, scene).events.of(Reason.HUB_LOST)[0][3] == {"hub": "1-2", "devices": 1, "roles": "compass"}


def test_three_of_four_cables_are_no_hub(tmp_path: Path):
    async def scene(bench: Bench) -> None:
        for name in ("1-1.1", "1-1.2", "1-1.3"):
            bench.usb.unplug(name)
        await bench.clock.sleep(1)

    assert play(tmp_path, scene).events.kept == []


def test_both_hubs_at_once_are_one_event_of_what_they_hang_on(tmp_path: Path):
    async def scene(bench: Bench) -> None:
        bench.usb.lose_hub("1-1")
        bench.usb.lose_hub("1-2")
        await bench.clock.sleep(1)
        assert bench.hubs.waiting == set(PORTS)
        await bench.usb.return_hub("usb1", bench.clock)
        await bench.clock.sleep(3)
        assert bench.hubs.waiting == frozenset()

    bench = play(tmp_path, scene)
    assert bench.events.reasons == [Reason.HUB_LOST, Reason.HUB_RETURNED]
    assert bench.events.of(Reason.HUB_LOST)[0][3] == {
        "hub": "usb1",
        "devices": 6,
        "roles": "lidar,steering,drive,stabiliser,compass",
    }


def test_a_hub_behind_a_lost_hub_is_part_of_it(tmp_path: Path):
    async def scene(bench: Bench) -> None:
        bench.usb.unplug("1-2.2")
        bench.usb.add_hub("1-2.2")
        bench.usb.add_device("1-2.2.1", "0403:6001", node="ttyUSB")
        await bench.clock.sleep(4)
        bench.events.kept.clear()
        bench.usb.lose_hub("1-2.2")
        await bench.clock.sleep(1)
        assert bench.events.of(Reason.HUB_LOST)[0][3]["hub"] == "1-2.2"
        bench.usb.lose_hub("1-2")
        await bench.clock.sleep(1)
        await bench.usb.return_hub("1-2", bench.clock)
        await bench.clock.sleep(2)
        assert UsbState.WAITING not in bench.states().values()

    bench = play(tmp_path, scene)
    assert bench.events.reasons == [Reason.HUB_LOST, Reason.HUB_LOST, Reason.HUB_RETURNED]


def test_a_hub_that_flickers_starts_nobody_until_it_is_still(tmp_path: Path):
    async def scene(bench: Bench) -> None:
        async with bench.drivers(*FIRST) as starts:
            for _ in range(5):
                bench.usb.lose_hub("1-1")
                await bench.clock.sleep(0.1)
                await bench.usb.return_hub("1-1", bench.clock, first=0.05, between=0.05)
                await bench.clock.sleep(0.15)
            assert all(len(times) == 1 for times in starts.values())
            await bench.clock.sleep(3)
            assert all(len(times) == 2 for times in starts.values())

    bench = play(tmp_path, scene)
    assert bench.events.reasons == [Reason.HUB_LOST, Reason.HUB_RETURNED]


def test_devices_of_two_hubs_that_were_lost_together_are_not_staggered_against_each_other(tmp_path: Path):
    async def scene(bench: Bench) -> None:
        async with bench.drivers() as starts:
            await bench.clock.sleep(3)
            bench.usb.lose_hub("1-1")
            bench.usb.lose_hub("1-2")
            await bench.clock.sleep(2)
            returned = bench.clock.now() / SECOND
            await asyncio.gather(*(bench.usb.return_hub(hub, bench.clock) for hub in ("1-1", "1-2")))
            await bench.clock.sleep(8)
            restarts = {role: times[1] - returned for role, times in starts.items()}
            assert restarts["lidar"] - restarts["drive"] == pytest.approx(0.3, abs=0.01), "it loads their hub"
            assert restarts["compass"] == pytest.approx(restarts["drive"], abs=0.01), "it loads another one"

    play(
        tmp_path,
        scene,
        UsbConfig(start_apart=("lidar", "compass"), start_order=("drive", "steering", "lidar", "compass")),
    )


def test_a_hub_lost_again_during_the_staggered_start(tmp_path: Path):
    async def scene(bench: Bench) -> None:
        async with bench.drivers(*FIRST) as starts:
            bench.usb.lose_hub("1-1")
            await bench.clock.sleep(1)
            await bench.usb.return_hub("1-1", bench.clock)
            await bench.clock.sleep(0.7)  # drive and steering have started
            assert [len(starts[role]) for role in ("drive", "steering", "lidar", "stabiliser")] == [2, 2, 1, 1]
            bench.usb.lose_hub("1-1")
            await bench.clock.sleep(5)
            assert bench.hubs.waiting == set(FIRST)
            await bench.usb.return_hub("1-1", bench.clock)
            await bench.clock.sleep(3)
            assert [len(starts[role]) for role in ("drive", "steering", "lidar", "stabiliser")] == [3, 3, 2, 2]

    play(tmp_path, scene)


def test_who_does_not_come_back_is_named_and_waits_no_longer(tmp_path: Path):
    async def scene(bench: Bench) -> None:
        bench.usb.lose_hub("1-1")
        bench.usb.unplug("1-1.4")
        await bench.clock.sleep(1)
        await bench.usb.return_hub("1-1", bench.clock)
        await bench.clock.sleep(3)
        assert bench.hubs.waiting == frozenset()
        assert bench.states()["1-1.4"] is UsbState.ABSENT
        bench.usb.plug("1-1.4")
        await bench.clock.sleep(0.2)
        assert bench.states()["1-1.4"] is UsbState.PRESENT, "a straggler starts on its own"

    bench = play(tmp_path, scene)
    [(severity, _, text, values)] = bench.events.of(Reason.HUB_RETURNED)
    assert severity is Severity.WARNING
    assert "missing: stabiliser" in text
    assert (values["devices"], values["missing"]) == (3, 1)


def test_a_hub_that_comes_back_empty_frees_its_devices_after_a_while(tmp_path: Path):
    async def scene(bench: Bench) -> None:
        bench.usb.lose_hub("1-1")
        for port in range(1, 5):
            bench.usb.unplug(f"1-1.{port}")
        await bench.clock.sleep(1)
        await bench.usb.return_hub("1-1", bench.clock)
        await bench.clock.sleep(2)
        assert bench.hubs.waiting == set(FIRST), "devices may need longer than their hub"
        await bench.clock.sleep(2)
        assert bench.hubs.waiting == frozenset()

    assert play(tmp_path, scene).events.of(Reason.HUB_RETURNED)[0][3]["missing"] == 4


def test_a_hub_that_is_new_starts_what_loads_it_apart_too(tmp_path: Path):
    async def scene(bench: Bench) -> None:
        bench.usb.unplug("1-1")
        async with bench.watching(), bench.drivers(*FIRST) as starts:
            await bench.clock.sleep(5)
            assert bench.hubs.waiting == frozenset(), "a hub that never was is an unplugged device, not an outage"
            assert {node.state for node in bench.out.kept[-1].nodes if node.role in FIRST} == {UsbState.ABSENT}
            await bench.usb.return_hub("1-1", bench.clock)
            await bench.clock.sleep(4)
            assert_apart({role: starts[role][0] for role in FIRST})

    bench = play(tmp_path, scene, watched=False)
    assert bench.events.reasons == [Reason.HUB_RETURNED]


def test_without_the_service_nobody_waits(tmp_path: Path):
    async def scene(bench: Bench) -> None:
        async with bench.watching():
            bench.usb.lose_hub("1-1")
            await bench.clock.sleep(1)
            waiting = asyncio.create_task(bench.hubs.wait_to_start("lidar"))
            await bench.clock.sleep(1)
            assert not waiting.done()
        await waiting
        assert bench.hubs.waiting == frozenset()
        assert bench.usb.watcher._hint is None
        await bench.hubs.wait_to_start("no such role")

    play(tmp_path, scene, watched=False)


def test_over_current_is_reported_and_the_port_left_alone(tmp_path: Path):
    async def scene(bench: Bench) -> None:
        async with bench.drivers("lidar") as starts:
            bench.usb.over_current("1-1.1")
            bench.usb.unplug("1-1.1")
            bench.usb.plug("1-1.1")
            await bench.clock.sleep(8)
            assert bench.states()["1-1.1"] is UsbState.HELD
            assert bench.hubs.waits_for("lidar") == "held after over-current at hub 1-1 port 1"
            assert len(starts["lidar"]) == 1
            await bench.clock.sleep(3)
            assert len(starts["lidar"]) == 2
            assert bench.node("1-1.1").over_current == 1

    bench = play(tmp_path, scene)
    [(severity, _, text, values)] = bench.events.of(Reason.OVER_CURRENT)
    assert severity is Severity.ERROR
    assert "hub 1-1 port 1 (lidar)" in text
    assert values == {"ports": "1-1.1", "roles": "lidar"}


def test_over_current_before_the_start_is_history(tmp_path: Path):
    async def scene(bench: Bench) -> None:
        bench.usb.over_current("1-1.1")
        async with bench.watching():
            await bench.clock.sleep(1)
            assert bench.hubs.waiting == frozenset()
            assert bench.node("1-1.1").over_current == 1

    assert play(tmp_path, scene, watched=False).events.kept == []


@pytest.mark.parametrize("permitted", [True, False])
def test_autosuspend_is_forbidden_or_reported_after_every_replug(tmp_path: Path, permitted: bool):
    async def scene(bench: Bench) -> None:
        if not permitted:
            bench.usb.refused.add("control")
        bench.usb.suspend_when_idle("1-1.1")
        await bench.clock.sleep(10)
        assert bench.node("1-1.1").autosuspend is not permitted
        assert len(bench.events.of(Reason.AUTOSUSPEND)) == 1
        bench.usb.unplug("1-1.1")
        await bench.clock.sleep(1)
        bench.usb.plug("1-1.1")
        await bench.clock.sleep(1)

    bench = play(tmp_path, scene)
    reported = bench.events.of(Reason.AUTOSUSPEND)
    assert len(reported) == 2
    severity, source, text, _ = reported[0]
    assert source == "lidar"
    assert severity is (Severity.INFO if permitted else Severity.WARNING)
    assert ("udev rule" in text) is not permitted
    assert bench.usb.sysfs.text(f"{DEVICES}/1-1.1/power/control") == ("on" if permitted else "auto")


def test_a_cable_in_another_port_is_reported(tmp_path: Path):
    async def scene(bench: Bench) -> None:
        bench.usb.unplug("1-1.2")
        await bench.clock.sleep(1)
        bench.usb.move("1-1.2", "1-2.3")
        await bench.clock.sleep(1)
        assert bench.states()["1-1.2"] is UsbState.ABSENT
        bench.usb.unplug("1-1.3")
        bench.usb.add_device("1-2.4", "0403:6001", serial="another adapter")
        await bench.clock.sleep(1)
        bench.usb.move("1-1.3", "1-1.2")  # the drive's cable in the steering's port
        await bench.clock.sleep(1)

    bench = play(tmp_path, scene)
    (_, _, text, values), (_, _, _, swapped) = bench.events.of(Reason.PORT_MOVED)
    assert "hub 1-1 port 2 (steering) seems to be at hub 1-2 port 3" in text
    assert values == {"configured": "1-1.2", "found": "1-2.3"}
    assert swapped == {"configured": "1-1.3", "found": "1-1.2"}


def test_twins_that_return_to_their_own_ports_have_not_moved(tmp_path: Path):
    async def scene(bench: Bench) -> None:
        for name in ("1-1.3", "1-1.4"):
            bench.usb.unplug(name)
            bench.usb.add_device(name, "0403:6001", node="ttyUSB")
        await bench.clock.sleep(1)
        bench.events.kept.clear()
        bench.usb.unplug("1-1.3")
        bench.usb.unplug("1-1.4")
        await bench.clock.sleep(1)
        bench.usb.plug("1-1.4")
        await bench.clock.sleep(1)

    assert play(tmp_path, scene).events.kept == []


def test_a_hub_in_another_port_is_reported(tmp_path: Path):
    async def scene(bench: Bench) -> None:
        bench.usb.unplug("1-1")
        await bench.clock.sleep(1)
        bench.usb.add_hub("1-3")
        await bench.clock.sleep(1)

    assert play(tmp_path, scene).events.of(Reason.PORT_MOVED)[0][3] == {"configured": "1-1", "found": "1-3"}


def test_the_tree_names_all_places(tmp_path: Path):
    async def scene(bench: Bench) -> None:
        await bench.clock.sleep(0.1)
        assert [node.name for node in bench.out.kept[-1].nodes][:4] == ["usb1", "1-1", "1-1.1", "1-1.2"]
        lidar = bench.node("1-1.1")
        assert (lidar.parent, lidar.usb_id, lidar.role, lidar.tty) == ("1-1", "15d1:0000", "lidar", "ttyACM0")
        assert bench.node("1-1").hub
        assert bench.node("1-2.2").role is None
        bench.usb.unplug("1-2.2")
        await bench.clock.sleep(1)
        assert "1-2.2" not in bench.states(), "nobody misses a device without a role"

    play(tmp_path, scene)
