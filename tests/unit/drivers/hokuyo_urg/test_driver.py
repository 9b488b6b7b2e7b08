"""The driver against the emulator on the virtual clock: start states, damage, loss, time."""

import asyncio
import contextlib
from itertools import pairwise
from typing import Any

import numpy as np
import pytest

from monstertruck_drivers.cable import MemoryPort
from monstertruck_drivers.hokuyo_urg.config import HokuyoConfig
from monstertruck_drivers.hokuyo_urg.driver import HokuyoDriver
from monstertruck_drivers.hokuyo_urg.protocol import build_fields
from monstertruck_runtime.clock import SECOND, VirtualClock, run_virtual
from monstertruck_runtime.errors import (
    DeviceFaultError,
    DeviceLostError,
    DeviceTimeoutError,
    PortBusyError,
    ProtocolError,
    WrongDeviceError,
)
from monstertruck_runtime.service import RestartPolicy, supervise
from monstertruck_schemas.health import ServiceHealth, ServiceState
from monstertruck_schemas.reasons import Reason
from tests.unit.drivers.hokuyo_urg.rig import STEP_NS, Pattern, Rig, bench
from tests.unit.drivers.kit import Events, Kept

MS = 1_000_000


@pytest.mark.parametrize("state", ["scip1", "scip2", "streaming", "time_adjust"])
def test_every_start_state_ends_in_a_stream(state: str):
    async def main(clock: VirtualClock) -> Rig:
        async with bench(clock, state=state) as rig:
            start = clock.now()
            async with rig.driving():
                await rig.out.total(5)
            assert rig.ready_at[0] - start < 1.2 * SECOND
            return rig

    rig = run_virtual(main)
    scan = rig.out.kept[0]
    assert len(scan.ranges) == 682
    assert scan.start_angle == pytest.approx((44 - 384) * 2 * np.pi / 1024)
    assert scan.end_angle == pytest.approx((725 - 384) * 2 * np.pi / 1024)
    assert scan.time_increment == pytest.approx(0.1 / 1024)
    assert scan.scan_time == pytest.approx(0.1)
    assert (scan.range_min, scan.range_max, scan.range_noise) == (0.02, 5.6, 0.005)
    assert scan.frame == "lidar"
    assert rig.events.reasons() == [Reason.DEVICE_READY]
    assert rig.events.kept[0][3]["serial"] == "H0706400"


def test_ranges_and_codes_are_those_of_the_world():
    async def main(clock: VirtualClock) -> list[Any]:
        async with bench(clock) as rig, rig.driving():
            await rig.out.total(4)
            return rig.out.kept

    scans = run_virtual(main)
    for number, scan in enumerate(scans, start=1):
        raw = 500 + np.arange(44, 726) * 5 + number
        raw[100 - 44 : 120 - 44] = np.arange(20)
        coded = raw < 20
        assert np.array_equal(scan.codes, np.where(coded, raw, 255))
        assert np.all(np.isposinf(scan.ranges[coded]))
        assert np.array_equal(scan.ranges[~coded], raw[~coded] / 1000)
    assert [scan.seq for scan in scans] == [0, 1, 2, 3]


@pytest.mark.parametrize("drift_ppm", [-200.0, 0.0, 200.0])
def test_stamps_are_those_of_the_first_beam(drift_ppm: float):
    """Drift, batching jitter and a wrap of the counter after two seconds."""

    async def main(clock: VirtualClock) -> tuple[list[int], list[int], list[int]]:
        source = Pattern()
        wrap = (1 << 24) - 2000
        async with bench(clock, source, timer_start=wrap, drift_ppm=drift_ppm, jitter=0.008) as rig, rig.driving():
            await rig.out.total(300)
            stamps = [scan.stamp for scan in rig.out.kept]
            received = [scan.received for scan in rig.out.kept]
            return stamps, received, source.times

    stamps, received, begun = run_virtual(main)
    truth = [round(time + 44 * STEP_NS) for time in begun]
    errors = np.array(stamps[:300]) - np.array(truth[:300])
    assert np.abs(errors).max() < 3 * MS
    assert np.all(np.diff(stamps) > 0)
    assert all(a > b for a, b in zip(received, stamps, strict=True))


def test_a_restarted_counter_is_reported_and_stamps_go_on():
    async def main(clock: VirtualClock) -> tuple[Rig, list[int]]:
        source = Pattern()
        async with bench(clock, source, timer_start=5_000_000) as rig, rig.driving():
            await rig.out.total(70)
            rig.emulator.inject("timer", "0")
            await rig.out.total(100)
            return rig, source.times

    rig, begun = run_virtual(main)
    errors = [scan.stamp - time - round(44 * STEP_NS) for scan, time in zip(rig.out.kept, begun, strict=True)]
    assert max(abs(error) for error in errors) < 3 * MS
    assert [kept[2] for kept in rig.events.kept][1:] == ["sensor's clock restarted"]


def test_cluster_skip_and_short_format():
    config = HokuyoConfig(scan_format="MS", cluster=3, skip=1, frame="front_lidar")

    async def main(clock: VirtualClock) -> Rig:
        async with bench(clock, config=config) as rig, rig.driving():
            await rig.out.total(3)
            return rig

    rig = run_virtual(main)
    scan = rig.out.kept[1]
    assert len(scan.ranges) == 228
    assert scan.frame == "front_lidar"
    assert scan.range_max == 4.095
    assert scan.start_angle == pytest.approx((45 - 384) * 2 * np.pi / 1024)
    assert scan.angle_increment == pytest.approx(3 * 2 * np.pi / 1024)
    assert scan.time_increment == pytest.approx(3 * 0.1 / 1024)
    assert rig.out.kept[2].stamp - scan.stamp == pytest.approx(0.2 * SECOND, abs=2 * MS)
    assert any(line == "MS0044072503100" for line in rig.emulator.received)


def test_an_old_unit_is_polled_in_its_own_dialect():
    async def main(clock: VirtualClock) -> Rig:
        async with bench(clock, firmware="2.2.5(04/Jun./2004)") as rig:
            async with rig.driving():
                await rig.out.total(20)
            return rig

    rig = run_virtual(main)
    assert rig.events.kept[0][3]["dialect"] == "SCIP 1.1"
    assert len(rig.out.kept[0].ranges) == 682
    assert np.all(np.diff([scan.stamp for scan in rig.out.kept]) == pytest.approx(0.1 * SECOND, abs=MS))
    assert list(rig.emulator.received)[-1] == "L0"
    assert rig.emulator.received.count("G04472501") == 20


@pytest.mark.parametrize("chunk", [1, 7, None])
def test_chunks_of_any_size(chunk: int | None):
    async def main(clock: VirtualClock) -> Rig:
        async with bench(clock) as rig:
            rig.port.device.faults.chunk = chunk
            async with rig.driving():
                await rig.out.total(5)
            return rig

    assert run_virtual(main).driver.dropped == 0


def test_everything_in_one_read():
    """A stall that ends: three scans arrive in one piece and are kept apart."""

    async def main(clock: VirtualClock) -> Rig:
        async with bench(clock) as rig, rig.driving():
            await rig.out.total(10)
            held: list[bytes] = []
            deliver = rig.port.device._deliver
            assert deliver is not None
            rig.port.device.connect(held.append)
            while len(held) < 3:
                await clock.sleep(0.05)
            rig.port.device.connect(deliver)
            deliver(b"".join(held))
            await rig.out.total(16)
            return rig

    rig = run_virtual(main)
    assert rig.driver.dropped == 0
    stamps = [scan.stamp for scan in rig.out.kept]
    assert np.diff(stamps) == pytest.approx(np.full(len(stamps) - 1, 0.1 * SECOND), abs=2 * MS)
    assert len({scan.received for scan in rig.out.kept[10:13]}) == 1


@pytest.mark.parametrize(("flip", "drop"), [(4e-4, 0.0), (0.0, 4e-4), (2e-4, 2e-4)])
def test_damaged_scans_are_dropped_and_the_rest_is_exact(flip: float, drop: float):
    async def main(clock: VirtualClock) -> tuple[Rig, int]:
        source = Pattern()
        config = HokuyoConfig(max_bad_scans=20, stale_periods=20)
        async with bench(clock, source, config=config) as rig, rig.driving():
            await rig.out.total(3)
            faults = rig.port.device.faults
            faults.seed(4)
            faults.flip_rate, faults.drop_rate = flip, drop
            await rig.out.total(30)
            return rig, len(source.times)

    rig, sent = run_virtual(main)
    assert rig.driver.dropped > 5
    assert sent - 30 <= rig.driver.dropped * 2
    for scan in rig.out.kept:
        number = round(scan.ranges[0] * 1000) - 500 - 44 * 5
        expected = 500 + np.arange(44, 726) * 5 + number
        valid = scan.codes == 255
        assert valid.sum() == 662
        assert np.array_equal(scan.ranges[valid], expected[valid] / 1000)
    assert Reason.DEVICE_PROTOCOL in rig.events.reasons()


def test_a_cut_line_costs_one_scan_and_garbage_none():
    async def main(clock: VirtualClock) -> tuple[Rig, int]:
        source = Pattern()
        async with bench(clock, source) as rig, rig.driving():
            await rig.out.total(3)
            rig.emulator.inject("cut")
            await rig.out.total(10)
            rig.port.device.faults.garbage = b"\x00\xff%%\nrubbish"
            await rig.out.total(20)
            return rig, len(source.times)

    rig, sent = run_virtual(main)
    assert rig.driver.dropped == 2  # the cut scan, and the garbage itself
    assert sent == 21


def test_too_many_damaged_scans_end_the_session():
    async def main(clock: VirtualClock) -> None:
        async with bench(clock, config=HokuyoConfig(stale_periods=50)) as rig:
            task = asyncio.create_task(rig.session())
            await rig.out.total(3)
            rig.port.device.faults.flip_rate = 0.02
            await task

    with pytest.raises(ProtocolError, match="damaged scans in a row"):
        run_virtual(main)


def test_a_stall_ends_the_session_within_five_periods():
    async def main(clock: VirtualClock) -> int:
        async with bench(clock) as rig:
            task = asyncio.create_task(rig.session())
            await rig.out.total(3)
            rig.port.device.faults.stalled = True
            start = clock.now()
            with pytest.raises(DeviceTimeoutError, match="no valid scan"):
                await task
            return clock.now() - start

    assert 0.5 * SECOND <= run_virtual(main) <= 0.81 * SECOND  # the wait for QT's answer included


def test_verification_is_waited_for():
    async def main(clock: VirtualClock) -> Rig:
        async with bench(clock) as rig, rig.driving():
            await rig.out.total(3)
            rig.emulator.inject("status", "21")
            await clock.sleep(3)
            assert len(rig.out.kept) == 3
            rig.emulator.inject("status", "98")
            await rig.out.total(10)
            return rig

    rig = run_virtual(main)
    assert [kept[3].get("status") for kept in rig.events.kept[1:]] == ["21", "98"]
    assert len(rig.ready_at) == 1


def test_verification_that_never_ends_ends_the_session():
    async def main(clock: VirtualClock) -> None:
        async with bench(clock) as rig:
            rig.emulator.inject("status", "49")
            await rig.session()

    with pytest.raises(DeviceTimeoutError):
        run_virtual(main)


@pytest.mark.parametrize("fault", [("status", "50"), ("status", "97"), ("laser", "on")])
def test_hardware_trouble_resets_the_sensor_once_and_is_reported(fault: tuple[str, ...]):
    async def main(clock: VirtualClock) -> list[str]:
        async with bench(clock) as rig:
            rig.emulator.inject("laser", "off")
            if fault[0] == "laser":
                rig.emulator.inject(*fault)
            task = asyncio.create_task(rig.session())
            if fault[0] == "status":
                await rig.out.total(2)
                rig.emulator.inject(*fault)
            with pytest.raises(DeviceFaultError):
                await task
            return list(rig.emulator.received)

    assert run_virtual(main).count("RS") == 1


def test_a_lying_seri_line_split_by_an_empty_line_is_accepted():
    async def main(clock: VirtualClock) -> Rig:
        async with bench(clock, serial="H1234567") as rig:
            rig.emulator.inject("seri")
            async with rig.driving():
                await rig.out.total(2)
            return rig

    assert run_virtual(main).events.kept[0][3]["serial"] == "H1234567"


def test_cancellation_silences_the_sensor():
    async def main(clock: VirtualClock) -> Rig:
        async with bench(clock) as rig:
            async with rig.driving():
                await rig.out.total(2)
            heard = list(rig.emulator.received)
            assert heard[-1] == "QT"
            assert rig.emulator._order is None
            return rig

    run_virtual(main)


def test_cancellation_does_not_wait_for_a_deaf_sensor():
    async def main(clock: VirtualClock) -> int:
        async with bench(clock) as rig:
            async with rig.driving():
                await rig.out.total(2)
                rig.emulator.inject("deaf")
                start = clock.now()
            return clock.now() - start

    assert run_virtual(main) == pytest.approx(0.3 * SECOND, abs=MS)


def test_a_deaf_sensor_that_streams_is_a_timeout_and_silence_too():
    async def main(clock: VirtualClock, state: str) -> None:
        async with bench(clock, state=state) as rig:
            rig.emulator.inject("deaf")
            await rig.session()

    for state in ("streaming", "scip2"):
        with pytest.raises(DeviceTimeoutError):
            run_virtual(lambda clock, state=state: main(clock, state))


def test_a_killed_host_leaves_it_streaming_and_the_next_takes_over():
    async def main(clock: VirtualClock) -> Rig:
        async with bench(clock) as rig:
            task = asyncio.create_task(rig.session())
            await rig.out.total(3)
            assert isinstance(rig.port, MemoryPort)
            rig.port.device.connect(None)  # the process is gone: no QT reaches the sensor
            link = rig.port._link
            assert link is not None
            link.close()
            with pytest.raises(DeviceLostError):
                await task
            assert rig.emulator._order is not None
            rig.port.device.take(b"MD00")  # and half a line was in its pipe
            await clock.sleep(1)
            async with rig.driving():
                await rig.out.total(6)
            return rig

    rig = run_virtual(main)
    assert len(rig.ready_at) == 2


@pytest.mark.parametrize("answer", [b"$C320.5P0.2R-18.3T19.0*3C\r\n", b"\x00", b"QT\n"])
def test_another_device_on_the_port(answer: bytes):
    async def main(clock: VirtualClock) -> None:
        port = MemoryPort("lidar")
        port.plug()

        async def other() -> None:
            while True:
                await port.device.read()
                port.device.write(answer)

        device = asyncio.create_task(other())
        try:
            await HokuyoDriver(HokuyoConfig(), port, clock, Kept(), Events()).run(lambda: None)
        finally:
            device.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await device

    with pytest.raises(WrongDeviceError, match="does not use SCIP"):
        run_virtual(main)


def test_another_unit_than_configured():
    async def main(clock: VirtualClock) -> None:
        async with bench(clock, config=HokuyoConfig(serial_number="H9999999")) as rig:
            await rig.session()

    with pytest.raises(WrongDeviceError, match="expected unit H9999999, found H0706400"):
        run_virtual(main)


def test_another_scanner_that_speaks_scip(monkeypatch: pytest.MonkeyPatch):
    async def main(clock: VirtualClock) -> None:
        async with bench(clock) as rig:
            emulator = rig.emulator
            monkeypatch.setattr(emulator, "_pp", lambda *_: ("00", pp))
            monkeypatch.setattr(emulator, "_version", lambda: {"PROD": "UTM-30LX", "PROT": "SCIP 2.0", "SERI": "1"})
            await rig.session()

    pp = build_fields(
        {
            "MODL": "UTM-30LX",
            "DMIN": 23,
            "DMAX": 60000,
            "ARES": 1440,
            "AMIN": 0,
            "AMAX": 1080,
            "AFRT": 540,
            "SCAN": 2400,
        }
    )
    with pytest.raises(WrongDeviceError, match="expected a URG scanner"):
        run_virtual(main)


def test_two_hosts_on_one_port():
    async def main(clock: VirtualClock) -> None:
        async with bench(clock) as rig, rig.driving():
            await rig.out.total(1)
            await rig.session()

    with pytest.raises(PortBusyError):
        run_virtual(main)


@pytest.mark.parametrize("powered", [True, False])
def test_unplugged_and_replugged_is_back_within_two_seconds(powered: bool):
    """With power lost it starts in SCIP 1.1 again, otherwise it is still streaming."""

    async def main(clock: VirtualClock) -> tuple[int, list[ServiceHealth]]:
        health: list[ServiceHealth] = []
        async with bench(clock) as rig:
            service = supervise(rig.driver, RestartPolicy(), clock, health.append, np.random.default_rng(0))
            task = asyncio.create_task(service)
            await rig.out.total(3)
            rig.port.unplug()
            await clock.sleep(3)
            before = len(rig.out.kept)
            if not powered:
                rig.emulator.power_cycle()
            rig.port.plug()
            start = clock.now()
            await rig.out.total(before + 1)
            took = clock.now() - start
            task.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await task
            return took, health

    took, health = run_virtual(main)
    assert took < 2 * SECOND
    states = [row.state for row in health]
    assert states[:3] == [ServiceState.STARTING, ServiceState.READY, ServiceState.BACKOFF]
    assert states[-2:] == [ServiceState.READY, ServiceState.STOPPED]
    assert health[2].reason is Reason.DEVICE_LOST


def test_a_sensor_that_restarts_under_the_driver_is_found_again():
    async def main(clock: VirtualClock) -> int:
        async with bench(clock) as rig:
            service = supervise(rig.driver, RestartPolicy(), clock, lambda _: None, np.random.default_rng(0))
            task = asyncio.create_task(service)
            await rig.out.total(3)
            rig.emulator.power_cycle()
            start = clock.now()
            before = len(rig.out.kept)
            await rig.out.total(before + 2)
            task.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await task
            return clock.now() - start

    assert run_virtual(main) < 2.5 * SECOND


def test_over_rs232_a_clustered_scan_fits():
    config = HokuyoConfig(scan_format="MS", cluster=2)

    async def main(clock: VirtualClock) -> Rig:
        async with bench(clock, config=config) as rig:
            rig.port.device.baud = 115200
            async with rig.driving():
                await rig.out.total(30)
            return rig

    rig = run_virtual(main)
    assert np.diff([scan.stamp for scan in rig.out.kept]) == pytest.approx(np.full(29, 0.1 * SECOND), abs=2 * MS)


def test_two_runs_are_identical():
    async def main(clock: VirtualClock) -> list[Any]:
        async with bench(clock, jitter=0.01, drift_ppm=50, seed=3) as rig, rig.driving():
            await rig.out.total(30)
            return rig.out.kept

    assert run_virtual(main) == run_virtual(main)


def test_a_scanner_without_time_adjust_mode_streams_and_says_so():
    async def main(clock: VirtualClock) -> Rig:
        async with bench(clock, drift_ppm=300.0) as rig:
            rig.emulator.inject("tm", "off")
            async with rig.driving():
                await rig.out.total(50)
            return rig

    rig = run_virtual(main)
    assert rig.events.reasons() == [Reason.CLOCK_DRIFT, Reason.DEVICE_READY]
    for scan, begin in zip(rig.out.kept, rig.emulator._source.times, strict=False):
        assert scan.stamp == pytest.approx(begin + 44 * STEP_NS, abs=5 * MS)


@pytest.mark.parametrize("ppm", ["-100000", "100000"])
def test_a_slewed_clock_keeps_the_scans_fresh(ppm: str):
    """Half a second within five, then as before; the gate refuses scans 0.4 s old."""

    async def main(clock: VirtualClock) -> Rig:
        async with bench(clock, jitter=0.005) as rig, rig.driving():
            await rig.out.total(100)
            rig.emulator.inject("drift", ppm)
            await clock.sleep(5.0)
            rig.emulator.inject("drift", "0")
            await clock.sleep(30.0)
            return rig

    rig = run_virtual(main)
    assert max(scan.received - scan.stamp for scan in rig.out.kept) < 200 * MS
    assert max(abs(b.stamp - a.stamp - 100 * MS) for a, b in pairwise(rig.out.kept[-50:])) < 10 * MS
    assert rig.events.reasons().count(Reason.CLOCK_DRIFT) == 1
    assert len(rig.ready_at) == 1


def test_scans_that_stay_late_start_the_session_anew():
    async def main(clock: VirtualClock) -> None:
        async with bench(clock) as rig, rig.driving():
            await rig.out.total(100)
            rig.port.device.faults.delay = 0.35
            await clock.sleep(10.0)

    with pytest.raises(DeviceTimeoutError, match="s since the start"):
        run_virtual(main)


def test_covers_and_mirrors_before_the_window():
    async def main(clock: VirtualClock) -> Rig:
        async with bench(clock) as rig:
            rig.emulator.inject("cover", "-10", "10", "19")
            rig.emulator.inject("cover", "20", "40", "7", "0.5")
            rig.emulator.inject("cover", "-40", "-20", "30")
            rig.emulator.inject("mirror", "-80", "-60")
            async with rig.driving():
                await rig.out.total(3)
                rig.emulator.inject("cover", "off")
                await rig.out.total(6)
            return rig

    rig = run_virtual(main)
    scan, clear = rig.out.kept[1], rig.out.kept[-1]
    degrees = np.degrees(scan.start_angle + scan.angle_increment * np.arange(682))
    assert set(scan.codes[abs(degrees) < 9.5]) == {19}
    assert 0.3 < np.mean(scan.codes[(degrees > 20.5) & (degrees < 39.5)] == 7) < 0.7
    assert set(scan.ranges[(degrees > -39.5) & (degrees < -20.5)]) == {0.03}
    assert 18 in scan.codes[(degrees > -72) & (degrees < -68)]
    side = (degrees > -79.5) & (degrees < -75)
    assert scan.ranges[side] == pytest.approx(2 * clear.ranges[side], abs=0.02)
