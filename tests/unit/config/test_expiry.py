"""Grades and validity of calibrations."""

import asyncio
import contextlib
import errno
import os
from dataclasses import replace
from pathlib import Path

import pytest

from monstertruck_drivers.config import PortConfig
from monstertruck_runtime.clock import SECOND, VirtualClock, run_virtual
from monstertruck_runtime.mailbox import latest
from monstertruck_runtime.plugins import load
from monstertruck_runtime.threads import inline
from monstertruck_schemas import topics
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.roles import DeviceRole
from monstertruck_schemas.sensor import Battery, BatteryLevel, DriveFeedback, DriveMode
from monstertruck_schemas.topics import BY_NAME, Writer
from monstertruck_schemas.usb import UsbNode, UsbState, UsbTree
from monstertruckd.bus.local import Bus
from monstertruckd.config.calibration import Estimate, Result, utc
from monstertruckd.config.expiry import (
    DAY,
    CalibrationWatch,
    DistanceCounter,
    degraded_topics,
    grade,
    stamped,
    state_of,
    worst,
)
from monstertruckd.config.load import load_config
from monstertruckd.config.truck import TruckConfig
from monstertruckd.config.wizards import WIZARDS

TRUCK = load_config(Path(__file__).resolve().parents[3] / "configs" / "truck.yaml", TruckConfig)[0]
NOW = 1_700_000_000 * SECOND


def result(half=2.0, wizard="drive", name="drive_ratio"):
    estimate = Estimate(name=name, value=600.0, low=600 - half, high=600 + half, samples=4, meaning="test")
    return Result(wizard=wizard, measured="test", estimates=(estimate,), date=utc(NOW))


def test_every_wizard_names_devices_topics_and_estimates_that_there_are():
    for wizard in WIZARDS.values():
        assert wizard.lifetime.role in set(DeviceRole)
        assert set(wizard.lifetime.topics) <= BY_NAME.keys()
        assert {step.complete for step in wizard.steps} - {"inverted"} <= wizard.goals.keys()
        assert callable(load(wizard.procedure))


@pytest.mark.parametrize(("half", "letter"), [(5.9, "A"), (6.1, "B"), (11.9, "B"), (12.1, "C")])
def test_a_grade_is_the_width_of_the_interval(half, letter):
    assert worst(result(half)) == letter
    assert stamped(result(half), TRUCK, NOW, 0.0).estimates[0].grade == letter


def test_what_has_no_interval_has_no_grade():
    sign = Estimate(name="inverted", value=True, samples=1, meaning="test")
    assert grade("drive", sign) is None


def test_time_way_and_another_part_end_it():
    saved = stamped(result(), TRUCK, NOW, 1000.0)
    life = WIZARDS["drive"].lifetime
    assert state_of(saved, TRUCK, NOW, 1000.0).expired == ""
    assert state_of(saved, TRUCK, NOW, 1000.0).metres_left == life.metres
    assert "valid until" in state_of(saved, TRUCK, NOW + (life.days + 1) * DAY, 1000.0).expired
    assert "exceeds its validity by 0.5 km" in state_of(saved, TRUCK, NOW, 1500.0 + life.metres).expired
    drive = TRUCK.devices.drive
    port = PortConfig(path=Path("/dev/other"))
    moved = TRUCK.model_copy(
        update={"devices": TRUCK.devices.model_copy(update={"drive": drive.model_copy(update={"port": port})})}
    )
    assert "/dev/other" in state_of(saved, moved, NOW, 1000.0).expired


def test_a_result_of_an_older_release_ends_by_its_date():
    old = result()
    assert state_of(old, TRUCK, NOW, 0.0).expired == ""
    assert state_of(old, TRUCK, NOW + 200 * DAY, 0.0).expired


def test_what_rests_on_it_is_named():
    assert degraded_topics(["battery"]) == {"sensor/battery"}
    assert degraded_topics(["drive"]) == {"state/odometry", "state/pose"}
    assert degraded_topics([]) == frozenset()


@pytest.mark.parametrize(
    "text",
    [
        *("", "{", "[1]", "[" * 100_000),
        *(f'{{"metres": {value}}}' for value in ('"x"', "NaN", "1e999", "-1", "1" + 400 * "0")),
    ],
)
def test_a_damaged_odometer_begins_at_nothing_and_says_so(text, tmp_path):
    file = tmp_path / "odometer.json"
    odometer = DistanceCounter(file)
    assert odometer.load() == ""  # a new robot
    file.write_text(text)
    assert odometer.load().startswith(f"{file}: ")
    assert odometer.metres == 0.0
    replace(odometer, metres=12.34).save()
    odometer.load()
    assert odometer.metres == 12.3


def test_an_odometer_that_cannot_be_read_is_no_new_robot(tmp_path):
    file = tmp_path / "odometer.json"
    file.symlink_to(file.name)
    assert DistanceCounter(file).load() == f"{file}: cannot be read: Too many levels of symbolic links"


def test_a_damaged_odometer_is_kept_and_an_event(tmp_path):
    file = tmp_path / "odometer.json"
    file.write_text("{")
    events: list[tuple[Reason, str, str]] = []

    async def main(clock: VirtualClock) -> None:
        sink = lambda *args, **_: events.append((args[0], args[2], args[3]))  # noqa: E731
        watch = CalibrationWatch(TRUCK, {}, Bus(clock), clock, sink, inline, DistanceCounter(file))
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(0.1):
                await watch.run(lambda: None)

    run_virtual(main)
    ((reason, source, text),) = events
    assert (reason, source) == (Reason.FILE_DAMAGED, "calibration")
    assert text.startswith(f"{file}: expected the distance driven")
    assert text.endswith("the file is kept as odometer.json.damaged")
    assert (tmp_path / "odometer.json.damaged").read_text() == "{"


@pytest.mark.parametrize(("code", "reason"), [(errno.ENOSPC, Reason.DISK_FULL), (errno.EROFS, Reason.RECORDING_FAILED)])
def test_an_odometer_that_cannot_be_written_is_reported_by_its_cause(code, reason, tmp_path, monkeypatch):
    def refuse(_: DistanceCounter) -> None:
        raise OSError(code, os.strerror(code))

    monkeypatch.setattr(DistanceCounter, "save", refuse)
    events: list[tuple[Reason, str]] = []

    async def main(clock: VirtualClock) -> None:
        file = tmp_path / "odometer.json"
        sink = lambda *args, **_: events.append((args[0], args[3]))  # noqa: E731
        watch = CalibrationWatch(TRUCK, {}, Bus(clock), clock, sink, inline, DistanceCounter(file))
        watch.odometer.metres = 100.0
        await watch._keep()

    run_virtual(main)
    ((found, text),) = events
    assert found is reason
    assert text.endswith(f"the distance driven cannot be saved: {os.strerror(code)}")


def test_a_value_of_zero_has_the_worst_grade_where_its_interval_is_meant_as_a_share_of_it():
    estimate = Estimate(name="wheelbase", value=0.0, low=-0.1, high=0.1, samples=1, meaning="test")
    assert grade("odometry", estimate) == "C"


def test_the_watch_marks_messages_tells_once_and_counts_the_way(tmp_path):
    old = result().model_copy(update={"wizard": "battery", "date": utc(-400 * DAY)})

    async def main(clock: VirtualClock):
        bus = Bus(clock)
        events = []
        watch = CalibrationWatch(
            TRUCK,
            {"battery": old},
            bus,
            clock,
            lambda *args, **_: events.append(args[0]),
            inline,
            DistanceCounter(tmp_path / "odometer.json"),
        )
        task = asyncio.create_task(watch.run(lambda: None))
        await clock.sleep(0.1)
        battery = bus.publisher(topics.BATTERY, Writer.DRIVER)
        with bus.subscribe(topics.BATTERY, latest()) as seen:
            battery.put(
                Battery(stamp=0, received=0, seq=0, voltage=24.0, raw_voltage=24.0, cells=6, level=BatteryLevel.NORMAL)
            )
            degraded = seen.latest.degraded
        drive = bus.publisher(topics.DRIVE, Writer.DRIVER)
        for k in range(130):
            position = 1000.0 * (k % 2)
            drive.put(
                DriveFeedback(stamp=k, received=k, seq=k, position=position, velocity=0.0, mode=DriveMode.ENABLED)
            )
            await clock.sleep(1.0)
        newest = bus.newest(topics.CALIBRATION)
        task.cancel()
        await asyncio.wait([task])
        return degraded, events, newest

    degraded, events, newest = run_virtual(main)
    assert degraded
    assert events == [Reason.CALIBRATION_EXPIRED]
    assert newest.wizards[0].expired
    way = 1000.0 * TRUCK.geometry.wheel_radius / TRUCK.geometry.drive_ratio
    assert newest.odometer == pytest.approx(119 * way, abs=2 * way)
    kept = DistanceCounter(tmp_path / "odometer.json")
    kept.load()
    assert kept.metres == pytest.approx(128 * way, abs=2 * way)


def test_another_device_on_the_same_port_is_reported_and_the_old_one_counts_again(tmp_path):
    node = UsbNode(name="1-1.2", role="drive", serial="A1", state=UsbState.PRESENT)

    async def main(clock: VirtualClock):
        bus = Bus(clock)
        events = []
        watch = CalibrationWatch(
            TRUCK,
            {},
            bus,
            clock,
            lambda *args, **_: events.append(args),
            inline,
            DistanceCounter(tmp_path / "odometer.json"),
        )
        tree = bus.publisher(topics.USB, Writer.DAEMON)
        task = asyncio.create_task(watch.run(lambda: None))

        async def plugged(serial: str | None) -> str:
            found = node.model_copy(update={"serial": serial})
            tree.put(UsbTree(stamp=clock.now(), received=clock.now(), seq=tree.next_seq(), nodes=(found,)))
            await clock.sleep(1.5)
            return watch.states()[0].expired if watch.states() else ""

        await plugged("A1")
        saved = watch.stamped(result())
        watch._results["drive"] = saved
        seen = [await plugged(serial) for serial in ("A1", "B2", None, "A1")]
        task.cancel()
        await asyncio.wait([task])
        return saved, seen, events

    saved, seen, events = run_virtual(main)
    assert saved.estimates[0].valid_until is not None
    assert saved.estimates[0].valid_until.serial == "A1"
    other = "drive was the device with serial number A1, it is B2"
    assert seen == ["", other, other, ""]  # an unplugged device is still the one that was seen last
    assert [args[3] for args in events] == [f"drive: {other}"]
