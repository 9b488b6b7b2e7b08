"""Levels need their dwell; spikes, bounces and gaps do not make one."""

from collections.abc import Iterable

import pytest

from monstertruck_drivers.maestro.battery import BatteryJudge
from monstertruck_drivers.maestro.config import BatteryConfig
from monstertruck_runtime.clock import SECOND
from monstertruck_schemas.sensor import BatteryLevel

L = BatteryLevel


class Bench:
    """Feeds a judge at 10 Hz."""

    def __init__(self) -> None:
        self.judge = BatteryJudge(BatteryConfig())
        self.time = 0
        self.voltage: float | None = None
        self.level = L.UNKNOWN

    def feed(self, volts: Iterable[float]) -> "Bench":
        for value in volts:
            self.time += SECOND // 10
            self.voltage, self.level = self.judge.update(self.time, value)
        return self

    def hold(self, volts: float, seconds: float) -> BatteryLevel:
        return self.feed([volts] * round(seconds * 10)).level


def test_unknown_until_the_median_is_full():
    bench = Bench()
    assert bench.hold(24.0, 0.4) is L.UNKNOWN
    assert bench.voltage is None
    assert bench.hold(24.0, 0.1) is L.NORMAL
    assert bench.voltage == 24.0


def test_low_after_ten_seconds_and_clear_after_thirty():
    bench = Bench()
    bench.hold(23.0, 2)
    assert bench.hold(21.9, 10.0) is L.NORMAL
    assert bench.hold(21.9, 0.5) is L.LOW
    assert bench.hold(22.3, 60) is L.LOW
    assert bench.hold(22.5, 30.0) is L.LOW
    assert bench.hold(22.5, 0.5) is L.NORMAL


def test_a_recovery_restarts_the_dwell():
    bench = Bench()
    for _ in range(5):
        bench.hold(21.9, 8)
        bench.hold(22.1, 1)
    assert bench.level is L.NORMAL


def test_critical_slowly_or_fast():
    bench = Bench()
    bench.hold(20.9, 10.0)
    assert bench.hold(20.9, 0.5) is L.CRITICAL
    assert bench.hold(21.5, 30) is L.CRITICAL, "critical ends only above the clear threshold"
    assert bench.hold(22.5, 30.5) is L.NORMAL
    bench = Bench()
    bench.hold(23.0, 2)
    assert bench.hold(19.5, 2.0) is L.NORMAL
    assert bench.hold(19.5, 0.5) is L.CRITICAL


def test_a_bouncing_connector_is_nothing():
    bench = Bench()
    for _ in range(20):
        bench.feed([23.0] * 9 + [0.0])
        assert bench.level in (L.UNKNOWN, L.NORMAL)
        bench.feed([23.0] * 9 + [50.0])
    assert bench.level is L.NORMAL
    assert bench.voltage == pytest.approx(23.0, abs=0.01)


@pytest.mark.parametrize("volts", [0.0, 14.9, 26.1, 50.0])
def test_implausible_voltage_is_a_sensor_fault_and_not_an_empty_battery(volts: float):
    bench = Bench()
    bench.hold(23.0, 2)
    assert bench.hold(volts, 0.5) is L.SENSOR_FAULT
    assert bench.voltage is None
    assert bench.hold(volts, 60) is L.SENSOR_FAULT
    assert bench.hold(23.0, 0.5) is L.NORMAL
    assert bench.voltage == 23.0


def test_a_fault_does_not_forget_that_the_battery_was_low():
    bench = Bench()
    bench.hold(21.5, 11)
    bench.hold(0.0, 5)
    assert bench.hold(21.5, 1) is L.LOW


def test_time_without_samples_does_not_count():
    bench = Bench()
    bench.hold(21.5, 5)
    bench.time += 60 * SECOND
    assert bench.hold(21.5, 5) is not L.LOW
    assert bench.hold(21.5, 6) is L.LOW


def test_smoothing_has_its_time_constant():
    bench = Bench()
    bench.hold(24.0, 2)
    bench.hold(23.0, 5.2)  # the median lags by two samples
    assert bench.voltage == pytest.approx(23 + 0.368, abs=0.01)


def test_smoothing_can_be_switched_off():
    judge = BatteryJudge(BatteryConfig(smoothing=0.0))
    for i in range(5):
        judge.update(i * SECOND // 10, 24.0)
    for i in range(5, 8):
        voltage, _ = judge.update(i * SECOND // 10, 23.0)
    assert voltage == 23.0
