"""Codec, driver and emulator of the RPLIDARs."""

import asyncio

import numpy as np
import pytest

from monstertruck_drivers.cable import DeviceEnd
from monstertruck_drivers.catalog import DEVICES
from monstertruck_drivers.config import Device
from monstertruck_drivers.rplidar.config import RplidarConfig
from monstertruck_drivers.rplidar.driver import RplidarDriver
from monstertruck_drivers.rplidar.emulator import RplidarEmulator
from monstertruck_drivers.rplidar.protocol import (
    COUNTS,
    MODELS,
    DataType,
    RplidarCommand,
    request,
)
from monstertruck_drivers.scanning.turns import MISSING
from monstertruck_runtime.clock import SECOND, VirtualClock, run_virtual
from monstertruck_runtime.errors import (
    DeviceFaultError,
    DeviceLostError,
    DeviceTimeoutError,
    InputError,
    ProtocolError,
    WrongDeviceError,
)
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.sensor import VALID_BEAM, LaserScan
from tests.unit.drivers.kit import DriverRig, Kept
from tests.unit.drivers.scanning.kit import Room, ahead

MODES = [(model, mode.name) for model, sheet in MODELS.items() for mode in sheet.modes]


class Rig(DriverRig):
    def __init__(self, clock, config=None, room=None, **emulator):
        super().__init__(clock, None)
        self.room = room or Room()
        self.config = config or RplidarConfig()
        self.emulator = RplidarEmulator(clock, self.room, MODELS[self.config.model], seed=1, **emulator)
        self.out: Kept[LaserScan] = Kept()
        self.driver = RplidarDriver(self.config, self.port, clock, self.out, self.events)


def on_bench(test, config=None, room=None, **emulator):
    async def main(clock: VirtualClock) -> None:
        rig = Rig(clock, config, room, **emulator)
        async with rig.plugged_in(rig.emulator.run(rig.port.device)):
            await test(rig)

    run_virtual(main)


@pytest.mark.parametrize(("model", "mode"), MODES)
def test_scans_of_every_model_in_every_mode_show_the_room(model, mode):
    async def test(rig: Rig) -> None:
        async with rig.driving():
            await rig.out.count(12)
            await rig.clock.sleep(2.0)
            await rig.out.count(6)
        sheet = MODELS[model]
        (listed,) = [each for each in sheet.modes if each.name == mode]
        for scan in rig.out.kept[-6:]:
            assert scan.angle_increment < 0.0, "clockwise"
            assert len(scan.ranges) == pytest.approx(1 / listed.sample_time / sheet.frequency, rel=0.02)
            assert (scan.codes == VALID_BEAM).mean() > 0.95
            assert scan.range_max == listed.longest
            assert scan.range_noise == sheet.ranges.error / 2
            off = rig.room.off(scan)
            assert np.percentile(off[ahead(scan)], 95) < 0.01
            assert off.max() < 4.3 * abs(scan.angle_increment) + 0.01
        assert rig.events.reasons() == [Reason.DEVICE_READY]

    on_bench(test, RplidarConfig(model=model, scan_mode=mode), Room(rate=1.0))


def test_the_makers_mode_is_taken_and_motor_and_scan_are_off_at_the_end():
    async def test(rig: Rig) -> None:
        async with rig.driving():
            await rig.out.count(3)
            assert rig.emulator.mode.name == "Boost"
            assert rig.emulator.head.frequency == pytest.approx(10.0)
        await rig.settle(0.1)
        assert rig.emulator.mode is None
        assert rig.emulator.head.frequency == 0.0

    on_bench(test, RplidarConfig(model="a2"))


def test_firmware_that_lists_no_modes_scans_express():
    async def test(rig: Rig) -> None:
        async with rig.driving():
            await rig.out.count(3)
        assert rig.events.kept[0][3]["mode"] == "Express"

    on_bench(test, firmware=(1, 20))


def test_a_mode_the_unit_has_not_is_named_with_those_it_has():
    async def test(rig: Rig) -> None:
        with pytest.raises(ProtocolError, match="'Boost'; it lists Standard, Express"):
            await rig.session()

    on_bench(test, RplidarConfig(scan_mode="Boost"))


def test_a_unit_left_scanning_by_a_dead_host_is_taken_over():
    async def test(rig: Rig) -> None:
        async with await rig.port.open() as link:
            await rig.settle(1.0)
            link.write(request(RplidarCommand.SCAN))
            await rig.settle(2.0)
            link.write(b"\xa5\x82\x05")
        async with rig.driving():
            await rig.out.count(3)

    on_bench(test)


def test_one_that_protects_itself_is_reset_once():
    async def test(rig: Rig) -> None:
        await rig.settle(1.0)
        rig.emulator.inject("health", "2", "0x8002")
        async with rig.driving():
            await rig.out.count(2)
        assert request(RplidarCommand.RESET) in bytes(rig.emulator.received)
        rig.emulator.inject("broken", "on")
        with pytest.raises(DeviceFaultError, match="0x8001"):
            await rig.session()

    on_bench(test)


def test_a_warning_is_reported_and_it_scans():
    async def test(rig: Rig) -> None:
        await rig.settle(1.0)
        rig.emulator.inject("health", "1", "0x10")
        async with rig.driving():
            await rig.out.count(2)
        assert rig.events.reasons() == [Reason.DEVICE_FAULT, Reason.DEVICE_READY]

    on_bench(test)


@pytest.mark.parametrize("mode", ["Standard", "Express"])
@pytest.mark.parametrize("damage", [{"flip_rate": 0.0004}, {"drop_rate": 0.0004}, {"lose_rate": 0.03}, {"chunk": 1}])
def test_bytes_lost_flipped_or_one_at_a_time(mode, damage):
    async def test(rig: Rig) -> None:
        async with rig.driving():
            await rig.out.count(12)
            rig.port.device.faults.seed(3)
            for name, value in damage.items():
                setattr(rig.port.device.faults, name, value)
            await rig.out.count(20)
        for scan in rig.out.kept[12:]:
            off = rig.room.off(scan)
            assert (off < 0.06).mean() > 0.97
        assert np.mean([(scan.codes == VALID_BEAM).mean() for scan in rig.out.kept[12:]]) > 0.75

    on_bench(test, RplidarConfig(scan_mode=mode))


@pytest.mark.parametrize(
    ("fault", "error"),
    [
        (("silent", "on"), DeviceTimeoutError),
        (("blocked", "on"), DeviceTimeoutError),
        (("bad_checksum", "9999"), ProtocolError),
    ],
)
def test_trouble_ends_the_session(fault, error):
    async def test(rig: Rig) -> None:
        async def trouble() -> None:
            await rig.out.count(5)
            rig.emulator.inject(*fault)

        asyncio.get_running_loop().create_task(trouble())
        with pytest.raises(error):
            await rig.session()

    on_bench(test)


def test_a_unit_that_is_deaf_a_replug_and_a_stall():
    async def test(rig: Rig) -> None:
        rig.emulator.inject("deaf", "on")
        with pytest.raises(DeviceTimeoutError):
            await rig.session()
        rig.emulator.inject("deaf", "off")

        async def later() -> None:
            await rig.out.count(3)
            rig.port.unplug()

        asyncio.get_running_loop().create_task(later())
        with pytest.raises(DeviceLostError):
            await rig.session()
        rig.port.plug()
        await rig.settle(0.2)
        async with rig.driving():
            await rig.out.count(3)
        assert len(rig.ready_at) == 2
        rig.port.device.faults.stalled = True
        with pytest.raises(DeviceTimeoutError):
            await rig.session()

    on_bench(test)


def test_a_covered_window_says_nothing():
    async def test(rig: Rig) -> None:
        async with rig.driving():
            await rig.out.count(12)
            rig.emulator.inject("cover", "30", "60", "7")
            rig.emulator.inject("torn")
            await rig.out.count(4)
        scan = rig.out.last
        bearings = np.degrees(scan.start_angle + scan.angle_increment * np.arange(len(scan.ranges)))
        assert set(scan.codes[(bearings > 32) & (bearings < 58)].tolist()) == {MISSING}

    on_bench(test)


def test_stamps_are_true_to_five_milliseconds_over_a_jittering_link():
    """Of three instants, 10 ms apart, the stamp is the one at which the room fits the scan of a turning robot best."""
    room = Room(rate=1.0)

    async def test(rig: Rig) -> None:
        async def jitter() -> None:
            rng = np.random.default_rng(1)
            while True:
                rig.port.device.faults.delay = float(rng.choice((0.0, 0.0, 0.016)))
                await rig.clock.sleep(0.02)

        task = asyncio.get_running_loop().create_task(jitter())
        async with rig.driving():
            await rig.clock.sleep(8.0)
        task.cancel()
        for scan in rig.out.kept[12:]:
            beams = np.flatnonzero(scan.codes == VALID_BEAM)
            ways = scan.start_angle + scan.angle_increment * beams
            times = scan.stamp + beams * scan.time_increment * SECOND
            off = []
            for late in (-0.01, 0.0, 0.01):
                seen = ways + room.yaw(times + late * SECOND)
                true = room.half / np.maximum(np.abs(np.cos(seen)), np.abs(np.sin(seen)))
                off.append(float(np.abs(true - scan.ranges[beams]).mean()))
            assert off[1] == min(off)

    on_bench(test, RplidarConfig(model="c1"), room)


@pytest.mark.parametrize("chatter", [b"$C123.4P1.0R-2.0*3A\r\n" * 20, bytes(188)])
def test_another_device_is_refused(chatter):
    async def speak(end: DeviceEnd, clock) -> None:
        while True:
            end.write(chatter)
            await clock.sleep(0.05)

    async def main(clock: VirtualClock) -> None:
        rig = Rig(clock)
        async with rig.plugged_in(speak(rig.port.device, clock)):
            with pytest.raises(WrongDeviceError, match="RPLIDAR"):
                await rig.session()

    run_virtual(main)


def test_another_unit_is_refused_probe_and_unknown_faults():
    async def test(rig: Rig) -> None:
        found = await DEVICES["rplidar"].identify(rig.port, rig.clock)
        assert found["device"] == "SLAMTEC RPLIDAR, model 0x61"
        assert found["modes"] == {"Standard": 4608, "DenseBoost": 9217}
        assert found["typical"] == "DenseBoost"
        rig.driver = RplidarDriver(
            RplidarConfig(model="s1", serial_number="0" * 32), rig.port, rig.clock, rig.out, rig.events
        )
        with pytest.raises(WrongDeviceError, match="expected unit 0000"):
            await rig.session()
        with pytest.raises(InputError, match="known: silent"):
            rig.emulator.inject("smoke")
        assert COUNTS[DataType.DENSE] == 40

    on_bench(test, RplidarConfig(model="s1"))


def test_a_motor_that_never_turns_is_named_and_the_rate_of_the_line_is_the_models():
    async def test(rig: Rig) -> None:
        rig.emulator.inject("blocked", "on")
        with pytest.raises(DeviceTimeoutError, match=r"port\.dtr false"):
            await rig.session()

    on_bench(test)
    device = Device[RplidarConfig].model_validate(
        {"port": {"path": "/dev/lidar"}, "driver": {"kind": "rplidar", "model": "c1"}}, strict=False
    )
    assert device.port.baud == 460800
