"""Codec, driver and emulator of a laser scanner described by its data sheet."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from monstertruck_drivers.catalog import DEVICES
from monstertruck_drivers.scanning.turns import MISSING
from monstertruck_drivers.sheet_lidar.config import SheetLidarConfig
from monstertruck_drivers.sheet_lidar.driver import SheetLidarDriver
from monstertruck_drivers.sheet_lidar.emulator import SheetLidarEmulator
from monstertruck_drivers.sheet_lidar.protocol import SheetParser, SheetScan, build
from monstertruck_runtime.clock import SECOND, VirtualClock, run_virtual
from monstertruck_runtime.errors import DeviceLostError, DeviceTimeoutError, InputError, ProtocolError, WrongDeviceError
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.sensor import NO_ECHO, VALID_BEAM, LaserScan
from tests.unit.drivers.kit import DriverRig, Kept
from tests.unit.drivers.scanning.kit import Room, ahead


class Rig(DriverRig):
    def __init__(self, clock, config=None, room=None, sheet=None):
        super().__init__(clock, None)
        self.room = room or Room()
        self.config = config or SheetLidarConfig()
        self.emulator = SheetLidarEmulator(clock, self.room, sheet or self.config, seed=1)
        self.out: Kept[LaserScan] = Kept()
        self.driver = SheetLidarDriver(self.config, self.port, clock, self.out, self.events)


def on_bench(test, config=None, room=None, sheet=None):
    async def main(clock: VirtualClock) -> None:
        rig = Rig(clock, config, room, sheet)
        async with rig.plugged_in(rig.emulator.run(rig.port.device)):
            await test(rig)

    run_virtual(main)


SCAN = SheetScan(70_000, np.arange(100, 108, dtype=np.uint16))


def test_bytes_of_a_frame():
    assert build(SCAN)[:9].hex() == "534c0800701101" + "6400"
    (scan,) = SheetParser(8).feed(build(SCAN))
    assert (scan.stamp, scan.ranges.tolist()) == (70_000, SCAN.ranges.tolist())


@given(st.binary(max_size=60), st.integers(1, 40))
def test_frames_are_found_among_any_bytes_however_they_are_cut(noise, size):
    parser = SheetParser(8)
    data = noise + build(SCAN) + build(SCAN)
    found = [scan for at in range(0, len(data), size) for scan in parser.feed(data[at : at + size])]
    found += parser.feed(bytes(30))
    assert [scan.stamp for scan in found][-1:] == [70_000]


def test_one_wrong_bit_is_noticed():
    for k in range(8 * len(build(SCAN))):
        damaged = bytearray(build(SCAN))
        damaged[k // 8] ^= 1 << k % 8
        assert SheetParser(8).feed(bytes(damaged) + bytes(30)) == []


@pytest.mark.parametrize("direction", ["clockwise", "counter_clockwise"])
@pytest.mark.parametrize(("beams", "view", "rate"), [(360, math.tau, 7.0), (721, math.pi, 20.0), (1081, 4.712, 40.0)])
def test_scans_of_a_turning_robot_have_the_geometry_of_the_data_sheet(beams, view, rate, direction):
    config = SheetLidarConfig(beams=beams, field_of_view=view, rate=rate, direction=direction)

    async def test(rig: Rig) -> None:
        async with rig.driving():
            await rig.out.count(50)
        scan = rig.out.last
        assert len(scan.ranges) == beams
        assert (scan.angle_increment < 0.0) == (direction == "clockwise")
        assert abs(scan.start_angle) == pytest.approx(view / 2)
        assert scan.scan_time == pytest.approx(1 / rate)
        assert rig.room.off(scan)[ahead(scan)].max() < 0.01
        assert 0 < (scan.received - scan.stamp) / SECOND < 1 / rate + 0.02
        stamps = np.diff([scan.stamp for scan in rig.out.kept[20:]]) / SECOND
        assert stamps.mean() == pytest.approx(1 / rate, rel=0.02)
        assert rig.events.reasons() == [Reason.DEVICE_READY]

    on_bench(test, config, Room(rate=1.0))


@pytest.mark.parametrize(("meaning", "code"), [("free", NO_ECHO), ("unknown", MISSING)])
def test_a_beam_without_a_return_is_free_or_unknown_as_configured(meaning, code):
    async def test(rig: Rig) -> None:
        rig.emulator.inject("cover", "-30", "30", "0")
        async with rig.driving():
            await rig.out.count(15)
        scan = rig.out.last
        assert set(scan.codes) == {VALID_BEAM, code}
        assert np.isinf(scan.ranges[scan.codes == code]).all()

    on_bench(test, SheetLidarConfig(no_return=meaning))


def test_another_data_sheet_is_refused_by_driver_and_probe():
    async def test(rig: Rig) -> None:
        with pytest.raises(WrongDeviceError, match="no measurement of a scanner with the configured number of beams"):
            await rig.driver.run(lambda: None)
        with pytest.raises(WrongDeviceError):
            await DEVICES["sheet_lidar"].identify(rig.port, rig.clock, rig.config)
        found = await DEVICES["sheet_lidar"].identify(rig.port, rig.clock, SheetLidarConfig(beams=100))
        assert found["beams"] == 100

    on_bench(test, sheet=SheetLidarConfig(beams=100))


@pytest.mark.parametrize(
    ("trouble", "error"),
    [("silent on", DeviceTimeoutError), ("bad_crc 100000", ProtocolError), ("unplug", DeviceLostError)],
)
def test_trouble_ends_the_session(trouble, error):
    async def test(rig: Rig) -> None:
        async with rig.driving() as session:
            await rig.out.count(10)
            if trouble == "unplug":
                rig.port.unplug()
            else:
                rig.emulator.inject(*trouble.split())
            await session

    with pytest.raises(error):
        on_bench(test)


def test_a_blocked_head_a_few_wrong_sums_and_unknown_faults():
    async def test(rig: Rig) -> None:
        async with rig.driving():
            await rig.out.count(10)
            rig.emulator.inject("bad_crc", "3")
            await rig.out.count(20)
            rig.emulator.inject("blocked", "on")
            await rig.clock.sleep(2.0)
        assert (rig.out.last.codes == MISSING).all()
        with pytest.raises(InputError, match="known: silent"):
            rig.emulator.inject("melt")

    on_bench(test)


def test_ranges_must_rise():
    with pytest.raises(ValidationError, match="expected increasing values"):
        SheetLidarConfig(range_max=4.0, range_dark=5.0)
    assert SheetLidarConfig(range_dark=5.0).sheet.sure == 5.0
