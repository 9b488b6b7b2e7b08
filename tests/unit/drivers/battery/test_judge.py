"""Levels need their dwell; spikes, bounces and gaps do not make one."""

from collections.abc import Iterable

import numpy as np
import pytest

from monstertruck_drivers.battery.config import PackConfig
from monstertruck_drivers.battery.monitor import CELL_VOLTS, BatteryJudge, charge_of
from monstertruck_runtime.clock import SECOND
from monstertruck_schemas.sensor import BatteryLevel
from monstertruck_sim.world.battery import BatteryModel
from monstertruck_sim.world.config import BatteryModelConfig

L = BatteryLevel


class Bench:
    """Feeds a judge at 10 Hz."""

    def __init__(self, **config: float) -> None:
        self.judge = BatteryJudge(PackConfig(**config))
        self.time = 0
        self.voltage: float | None = None
        self.rest: float | None = None
        self.level = L.UNKNOWN

    def feed(self, volts: Iterable[float], current: float | None = None) -> "Bench":
        for value in volts:
            self.time += SECOND // 10
            verdict = self.judge.update(self.time, value, current)
            self.voltage, self.rest, self.level = verdict.voltage, verdict.rest_voltage, verdict.level
        return self

    def hold(self, volts: float, seconds: float, current: float | None = None) -> BatteryLevel:
        return self.feed([volts] * round(seconds * 10), current).level


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
    judge = BatteryJudge(PackConfig(smoothing=0.0))
    for i in range(5):
        judge.update(i * SECOND // 10, 24.0)
    for i in range(5, 8):
        verdict = judge.update(i * SECOND // 10, 23.0)
    assert verdict.voltage == 23.0


def test_the_motors_current_explains_a_sag():
    loaded, current = 21.7, 8.0  # 22.18 V at rest
    assert Bench().hold(loaded, 30, current=None) is L.LOW
    bench = Bench()
    assert bench.hold(loaded, 30, current) is L.NORMAL
    assert bench.voltage == pytest.approx(21.7)
    assert bench.rest == pytest.approx(21.7 + 8.0 * 0.06)
    assert Bench().hold(loaded, 30, -current) is L.NORMAL, "braking and reversing draw current too"


def test_a_wrong_current_cannot_hide_an_empty_pack():
    bench = Bench()
    assert bench.hold(20.4, 30, current=1000.0) is L.LOW
    assert bench.rest == pytest.approx(20.4 + 1.5)
    assert Bench().hold(19.7, 30, current=1000.0) is L.CRITICAL, "collapsed is judged as measured"


def test_overcharged_after_its_dwell_until_below_full():
    bench = Bench()
    assert bench.hold(25.4, 2.0) is L.NORMAL
    assert bench.hold(25.4, 1.0) is L.OVERCHARGED
    assert bench.hold(25.25, 5) is L.OVERCHARGED
    assert bench.hold(25.15, 1) is L.NORMAL
    assert Bench().hold(25.2, 60, current=5.0) is L.NORMAL, "a guess of the sag makes no full pack overcharged"


def test_an_end_of_the_converters_scale_is_a_fault_however_wide_the_plausible_range():
    bad = float("nan")
    bench = Bench(plausible_min=0.0)
    bench.hold(23.0, 2)
    assert bench.feed([bad] * 2).level is L.NORMAL
    assert bench.feed([bad]).level is L.SENSOR_FAULT
    assert bench.hold(23.0, 0.5) is L.NORMAL


def test_charge_follows_the_table_and_stays_within_its_ends():
    assert [charge_of(volts) for volts in CELL_VOLTS] == pytest.approx([i / 20 for i in range(21)])
    assert charge_of(3.78) == pytest.approx(0.325)
    assert (charge_of(2.0), charge_of(5.0)) == (0.0, 1.0)


def test_limits_must_be_in_order():
    with pytest.raises(ValueError, match=r"overcharged_clear 25\.4 < overcharged 25\.3"):
        PackConfig(overcharged_clear=25.4)


@pytest.mark.parametrize("motor_w", [0.0, 40.0, 100.0])
def test_with_a_fitted_resistance_the_charge_is_right_to_a_tenth(motor_w: float):
    """Against the simulated pack, through its divider and a 10-bit converter, from full to a tenth."""
    pack = BatteryModel(BatteryModelConfig())
    judge = BatteryJudge(PackConfig(resistance=0.12))
    rng = np.random.default_rng(0)
    time, errors = 0, []
    while pack.charge > 0.1:
        pack.step(20.0, motor_w)
        for _ in range(10):
            time += SECOND // 10
            counts = round((pack.analog_volts + 0.003 * rng.standard_normal()) / 5 * 1023)
            verdict = judge.update(time, counts * 50 / 1023, motor_w / pack.volts)
        assert verdict.rest_voltage is not None
        errors.append(charge_of(verdict.rest_voltage / 6) - pack.charge)
    assert max(map(abs, errors)) < 0.1
