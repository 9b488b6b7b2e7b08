"""Codec, driver and emulator of the LD06, LD19 and STL-19P."""

import asyncio

import numpy as np
import pytest

from monstertruck_drivers.cable import DeviceEnd
from monstertruck_drivers.catalog import DEVICES
from monstertruck_drivers.ld19.config import Ld19Config
from monstertruck_drivers.ld19.driver import Ld19Driver
from monstertruck_drivers.ld19.emulator import Ld19Emulator
from monstertruck_drivers.ld19.protocol import FULL_TURN, MODELS, POINTS
from monstertruck_drivers.scanning.turns import MISSING
from monstertruck_runtime.clock import SECOND, VirtualClock, run_virtual
from monstertruck_runtime.errors import (
    DeviceLostError,
    DeviceTimeoutError,
    InputError,
    ProtocolError,
    WrongDeviceError,
)
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.sensor import NO_ECHO, VALID_BEAM, LaserScan
from tests.unit.drivers.kit import DriverRig, Kept
from tests.unit.drivers.scanning.kit import Room, ahead

"""The example of the development manual."""


class Rig(DriverRig):
    def __init__(self, clock, config=None, room=None):
        super().__init__(clock, None)
        self.room = room or Room()
        self.config = config or Ld19Config()
        self.emulator = Ld19Emulator(clock, self.room, MODELS[self.config.model], seed=1)
        self.out: Kept[LaserScan] = Kept()
        self.driver = Ld19Driver(self.config, self.port, clock, self.out, self.events)


def on_bench(test, config=None, room=None):
    async def main(clock: VirtualClock) -> None:
        rig = Rig(clock, config, room)
        async with rig.plugged_in(rig.emulator.run(rig.port.device)):
            await test(rig)

    run_virtual(main)


@pytest.mark.parametrize(("model", "rate"), [("ld06", 0.0), ("ld19", 1.0), ("stl19p", -1.0)])
def test_scans_of_a_turning_robot_show_the_room(model, rate):
    async def test(rig: Rig) -> None:
        async with rig.driving():
            await rig.out.count(60)
        count = MODELS[model].rate / 10
        for scan in rig.out.kept[30:]:
            assert scan.angle_increment < 0.0, "clockwise"
            assert len(scan.ranges) == pytest.approx(count, abs=2)
            assert scan.scan_time == pytest.approx(0.1, rel=0.02)
            assert scan.range_noise == 0.0225
            off = rig.room.off(scan)
            assert off[ahead(scan)].max() < 0.01
            assert off.max() < 4.3 * abs(scan.angle_increment)
            assert 0 < (scan.received - scan.stamp) / SECOND < 0.13
            assert scan.intensities[scan.codes == VALID_BEAM].min() > 0
        assert rig.events.reasons() == [Reason.DEVICE_READY]
        assert bytes(rig.emulator.received) == b""

    on_bench(test, Ld19Config(model=model), Room(rate=rate))


def test_the_head_comes_up_to_speed_before_the_first_scan():
    async def test(rig: Rig) -> None:
        async with rig.driving():
            await rig.out.count(3)
        assert 0.5 < rig.ready_at[0] / SECOND < 2.0
        assert all((scan.codes == VALID_BEAM).mean() > 0.9 for scan in rig.out.kept[1:])

    on_bench(test)


@pytest.mark.parametrize("hertz", [5.0, 8.0, 13.0])
def test_the_number_of_beams_follows_the_speed_of_the_head(hertz):
    async def test(rig: Rig) -> None:
        rig.emulator.inject("frequency", str(hertz))
        async with rig.driving():
            await rig.out.count(30)
        scan = rig.out.last
        assert len(scan.ranges) == pytest.approx(4500 / hertz, abs=2)
        assert scan.scan_time == pytest.approx(1 / hertz, rel=0.01)
        assert rig.room.off(scan)[ahead(scan)].max() < 0.01

    on_bench(test)


@pytest.mark.parametrize("ppm", [0, 500, -500])
def test_stamps_are_true_to_five_milliseconds_across_the_wrap_of_its_clock(ppm):
    """Of three instants, 10 ms apart, the stamp is the one at which the room fits the scan of a turning robot best."""
    room = Room(rate=1.0)

    async def test(rig: Rig) -> None:
        rig.emulator.inject("drift", str(ppm))
        async with rig.driving():
            await rig.clock.sleep(36.0)
        for scan in rig.out.kept[20:]:
            valid = scan.codes == VALID_BEAM
            beams = np.flatnonzero(valid)
            times = scan.stamp + beams * scan.time_increment * SECOND
            ways = scan.start_angle + scan.angle_increment * beams
            off = []
            for late in (-0.01, 0.0, 0.01):
                seen = ways + room.yaw(times + late * SECOND)
                true = room.half / np.maximum(np.abs(np.cos(seen)), np.abs(np.sin(seen)))
                off.append(float(np.abs(true - scan.ranges[beams]).mean()))
            assert off[1] == min(off)

    on_bench(test, room=room)


@pytest.mark.parametrize(
    ("damage", "valid"),
    [({"flip_rate": 0.002}, 0.7), ({"drop_rate": 0.002}, 0.7), ({"lose_rate": 0.05}, 0.7), ({"chunk": 1}, 0.99)],
)
def test_bytes_lost_flipped_or_one_at_a_time(damage, valid):
    async def test(rig: Rig) -> None:
        rig.port.device.faults.seed(3)
        for name, value in damage.items():
            setattr(rig.port.device.faults, name, value)
        async with rig.driving():
            await rig.out.count(80)
        for scan in rig.out.kept[30:]:
            assert len(scan.ranges) == pytest.approx(450, abs=3)
            assert (scan.codes == VALID_BEAM).mean() > valid - 0.25
            assert rig.room.off(scan)[ahead(scan)].max() < 0.01
        assert np.mean([(scan.codes == VALID_BEAM).mean() for scan in rig.out.kept[30:]]) > valid

    on_bench(test)


@pytest.mark.parametrize(
    ("fault", "error"),
    [
        (("silent", "on"), DeviceTimeoutError),
        (("blocked", "on"), DeviceTimeoutError),
        (("bad_crc", "9999"), ProtocolError),
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


def test_a_few_wrong_sums_and_half_a_packet_do_no_harm():
    async def test(rig: Rig) -> None:
        async with rig.driving():
            await rig.out.count(30)
            rig.emulator.inject("bad_crc", "3")
            rig.emulator.inject("half_packet")
            await rig.out.count(5)
        short = [scan for scan in rig.out.kept[25:] if (scan.codes == VALID_BEAM).sum() < 440]
        assert len(short) in (1, 2)
        assert all((scan.codes[scan.codes != VALID_BEAM] == MISSING).all() for scan in short)

    on_bench(test)


def test_a_stall_a_replug_and_silence():
    async def test(rig: Rig) -> None:
        async def later() -> None:
            await rig.out.count(3)
            rig.port.unplug()

        asyncio.get_running_loop().create_task(later())
        with pytest.raises(DeviceLostError):
            await rig.session()
        rig.port.plug()
        async with rig.driving():
            await rig.out.count(3)
        assert len(rig.ready_at) == 2
        rig.port.device.faults.stalled = True
        with pytest.raises(DeviceTimeoutError):
            await rig.session()

    on_bench(test)


@pytest.mark.parametrize(("setting", "code"), [("unknown", MISSING), ("free", NO_ECHO)])
def test_a_covered_window_says_nothing_unless_configured(setting, code):
    async def test(rig: Rig) -> None:
        async with rig.driving():
            await rig.out.count(3)
            rig.emulator.inject("cover", "30", "60", "7")
            await rig.out.count(4)
        scan = rig.out.last
        bearings = np.degrees(scan.start_angle + scan.angle_increment * np.arange(len(scan.ranges)))
        covered = (bearings > 31) & (bearings < 59)
        assert set(scan.codes[covered].tolist()) == {code}
        assert (scan.codes[~((bearings > 29) & (bearings < 61))] == VALID_BEAM).mean() > 0.99

    on_bench(test, Ld19Config(no_return=setting))


def test_a_mirror_and_a_hand_before_the_window():
    async def test(rig: Rig) -> None:
        rig.emulator.inject("cover", "-10", "10", "45")
        rig.emulator.inject("mirror", "80", "100")
        async with rig.driving():
            await rig.out.count(15)
        scan = rig.out.last
        bearings = np.degrees(scan.start_angle + scan.angle_increment * np.arange(len(scan.ranges)))
        assert scan.ranges[np.abs(bearings) < 9] == pytest.approx(0.045)
        behind = scan.ranges[(bearings > 82) & (bearings < 98) & (scan.codes == VALID_BEAM)]
        assert len(behind) > 5
        assert behind.min() >= 6.0

    on_bench(test)


@pytest.mark.parametrize("chatter", [b"$C123.4P1.0R-2.0*3A\r\n" * 20, bytes(188)])
def test_another_device_is_refused(chatter):
    async def speak(end: DeviceEnd, clock) -> None:
        while True:
            end.write(chatter)
            await clock.sleep(0.05)

    async def main(clock: VirtualClock) -> None:
        rig = Rig(clock)
        async with rig.plugged_in(speak(rig.port.device, clock)):
            with pytest.raises(WrongDeviceError, match="LD19"):
                await rig.session()

    run_virtual(main)


def test_probe_and_unknown_faults():
    async def test(rig: Rig) -> None:
        found = await DEVICES["ld19"].identify(rig.port, rig.clock)
        assert "LD19" in found["device"]
        assert len(found["ranges_m"]) == POINTS
        with pytest.raises(InputError, match="known: silent"):
            rig.emulator.inject("smoke")
        with pytest.raises(InputError, match="cover FROM"):
            rig.emulator.inject("cover", "10", "5", "3")
        assert FULL_TURN == 36_000

    on_bench(test)
