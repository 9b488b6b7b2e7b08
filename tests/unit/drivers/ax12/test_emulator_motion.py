"""How emulated units move, overload, heat up and go limp."""

import numpy as np
import pytest

from monstertruck_drivers.ax12 import protocol as p
from monstertruck_drivers.ax12.emulator import Ax12Bus
from monstertruck_drivers.ax12.protocol import STEP, Alarm, Present
from monstertruck_drivers.ax12.unit import AMBIENT, OVERLOAD_TIME
from monstertruck_runtime.clock import SECOND
from monstertruck_runtime.errors import InputError
from tests.unit.drivers.ax12.rig import Host, on_wire, present, value, write

# Motion


def test_it_moves_at_moving_speed_and_stops_within_the_margin():
    async def test(bus: Ax12Bus, host: Host, clock) -> None:
        await host.status(write(1, p.MOVING_SPEED, 102))  # 11.3 rpm: 231.6 steps a second
        await host.status(write(1, p.TORQUE_ENABLE, 1))
        await host.status(write(1, p.GOAL_POSITION, 812))
        start = clock.now()
        await clock.sleep(0.48)
        now = await present(host)
        expected = 512 + 102 * p.SPEED_UNIT / STEP * (clock.now() - start - 0.02 * SECOND) / SECOND
        assert now.position == pytest.approx(expected, abs=5)
        assert now.speed == pytest.approx(102, abs=1)
        assert now.load > 0
        assert await value(host, 1, p.MOVING) == 1
        await clock.sleep(2)
        now = await present(host)
        assert abs(now.position - 812) <= 1
        assert now.speed == now.load == 0
        assert await value(host, 1, p.MOVING) == 0
        await host.status(write(1, p.GOAL_POSITION, 512))
        await clock.sleep(0.3)
        now = await present(host)
        assert now.speed == pytest.approx(-102, abs=1)
        assert now.load < 0
        assert bus.angle(2, clock.now()) == pytest.approx(512 * STEP), "the other one stands"

    on_wire(test)


@pytest.mark.parametrize(("slope", "margin"), [(4, 0), (32, 1), (128, 10)])
def test_slope_and_margin_shape_the_arrival(slope: int, margin: int):
    async def test(bus: Ax12Bus, host: Host, clock) -> None:
        await host.status(p.write(1, p.CW_MARGIN, bytes((margin, margin, slope, slope))))
        await host.status(write(1, p.TORQUE_ENABLE, 1))
        await host.status(write(1, p.GOAL_POSITION, 612))
        await clock.sleep(3)
        left = 612 - bus.angle(1, clock.now()) / STEP
        assert left == pytest.approx(margin, abs=0.6)
        assert await value(host, 1, p.MOVING) == 0, "at rest"
        loads = []
        await host.status(write(1, p.GOAL_POSITION, 512))
        for _ in range(40):
            now = await present(host)
            loads.append((now.position - 512, -now.load))
        for error, load in loads:
            if margin + 4 < error:
                assert load == pytest.approx(1000 * min(1, (error - margin) / p.slope_of(slope)), abs=1500 / slope)

    on_wire(test)


def test_the_punch_is_the_least_drive():
    async def test(_bus, host: Host, _clock) -> None:
        await host.status(p.write(1, p.CW_MARGIN, bytes((0, 0, 128, 128))))
        await host.status(write(1, p.GOAL_POSITION, 514))
        await host.status(write(1, p.TORQUE_ENABLE, 1))
        assert (await present(host)).load == 31
        await host.status(write(1, p.PUNCH, 100))
        await host.status(write(1, p.GOAL_POSITION, 508))
        assert (await present(host)).load == -98

    on_wire(test)


def test_torque_limit_cuts_the_drive_and_zero_leaves_it_limp():
    async def test(bus: Ax12Bus, host: Host, clock) -> None:
        await host.status(write(1, p.TORQUE_ENABLE, 1))
        await host.status(write(1, p.TORQUE_LIMIT, 512))
        await host.status(write(1, p.GOAL_POSITION, 900))
        assert (await present(host)).load == pytest.approx(500, abs=2)
        await host.status(write(1, p.TORQUE_LIMIT, 0))
        before = bus.angle(1, clock.now())
        await clock.sleep(1)
        assert bus.angle(1, clock.now()) == before

    on_wire(test)


def test_a_load_slows_it_and_moves_a_limp_one():
    push = {1: -0.5, 2: 0.1}

    async def test(bus: Ax12Bus, host: Host, clock) -> None:
        await host.status(write(1, p.TORQUE_ENABLE, 1))
        await host.status(write(1, p.GOAL_POSITION, 512))
        await clock.sleep(1)
        sagged = 512 - bus.angle(1, clock.now()) / STEP
        assert sagged == pytest.approx(1 + 32 * 0.5 / 1.5 * 12 / 11.1, abs=1), "the slope is a spring"
        assert (await present(host)).load == pytest.approx(1000 * 0.5 / 1.5 * 12 / 11.1, abs=20)
        await host.status(write(1, p.TORQUE_ENABLE, 0))
        await clock.sleep(0.2)
        assert bus.angle(1, clock.now()) < (512 - sagged - 20) * STEP
        assert bus.angle(2, clock.now()) == 512 * STEP, "the gear's friction holds a small load"

    on_wire(test, load=lambda ident, _: push[ident])


def test_both_limits_zero_turn_endlessly():
    async def test(bus: Ax12Bus, host: Host, clock) -> None:
        await host.status(p.write(1, p.CW_LIMIT, bytes(4)))
        await host.status(write(1, p.TORQUE_ENABLE, 1))
        await host.status(write(1, p.MOVING_SPEED, 512 | 1024))
        await clock.sleep(1)
        assert (await present(host)).speed < 0
        seen = {round(bus.angle(1, clock.now() + i * SECOND // 10)) for i in range(30)}
        assert len(seen) >= 6, "all round"

    on_wire(test)


def test_a_blocked_unit_overloads_gets_hot_and_shuts_down():
    async def test(bus: Ax12Bus, host: Host, clock) -> None:
        bus.inject("block", "1", "on")
        await host.status(write(1, p.TORQUE_ENABLE, 1))
        await host.status(write(1, p.GOAL_POSITION, 900))
        now = await present(host)
        assert (now.position, now.speed, now.load) == (512, 0, 1000)
        await clock.sleep(OVERLOAD_TIME - 0.2)
        assert (await host.status(p.ping(1))).code == 0
        await clock.sleep(0.3)
        status = await host.status(write(1, p.LED, 1))
        assert status.code == Alarm.OVERLOAD, "writes are still answered"
        assert await value(host, 1, p.TORQUE_LIMIT) == 0
        assert await value(host, 1, p.TORQUE_ENABLE) == 1, "only the limit tells"
        assert (await present(host)).load == 0
        bus.inject("block", "1", "off")
        await clock.sleep(5)
        assert bus.angle(1, clock.now()) == 512 * STEP
        assert (await host.status(p.ping(1))).code == Alarm.OVERLOAD
        assert (await host.status(write(1, p.TORQUE_LIMIT, 1023))).code == 0
        await clock.sleep(0.02)
        assert bus.angle(1, clock.now()) > 512 * STEP, "with the old goal it jumps"

    on_wire(test)


def test_error_bits_may_clear_while_it_stays_limp():
    async def test(bus: Ax12Bus, host: Host, clock) -> None:
        bus.inject("latch", "off")
        bus.inject("block", "1", "on")
        await host.status(write(1, p.TORQUE_ENABLE, 1))
        await host.status(write(1, p.GOAL_POSITION, 900))
        await clock.sleep(2)
        assert (await host.status(p.ping(1))).code == 0
        assert await value(host, 1, p.TORQUE_LIMIT) == 0

    on_wire(test)


def test_heat_rises_with_the_drive_and_trips_the_alarm():
    async def test(bus: Ax12Bus, host: Host, clock) -> None:
        await host.status(write(1, p.SHUTDOWN, int(Alarm.OVERHEAT)))
        bus.inject("block", "1", "on")
        await host.status(write(1, p.TORQUE_ENABLE, 1))
        await host.status(write(1, p.GOAL_POSITION, 900))
        await clock.sleep(30)
        warm = (await present(host)).temperature
        assert AMBIENT + 10 < warm < 70
        while Alarm.OVERHEAT not in Alarm((await host.status(p.ping(1))).code):
            await clock.sleep(1)
        assert (await present(host)).temperature == pytest.approx(70, abs=1)
        assert await value(host, 1, p.TORQUE_LIMIT) == 0
        await clock.sleep(200)
        assert (await present(host)).temperature < warm

    on_wire(test)


def test_an_alarm_outside_the_mask_changes_nothing_but_the_bit():
    async def test(bus: Ax12Bus, host: Host, _clock) -> None:
        await host.status(write(1, p.SHUTDOWN, int(Alarm.OVERHEAT)))
        bus.inject("trip", "1")
        assert (await host.status(p.ping(1))).code == Alarm.OVERLOAD
        assert await value(host, 1, p.TORQUE_LIMIT) == 1023

    on_wire(test)


def test_voltage_follows_its_source_and_sets_its_bit():
    volts = [12.0]

    async def test(bus: Ax12Bus, host: Host, clock) -> None:
        assert (await present(host)).voltage == 120
        volts[0] = 5.5
        await clock.sleep(0.1)
        now = await host.status(p.read(1, p.PRESENT_POSITION, 8))
        assert now.code == Alarm.VOLTAGE
        assert Present.decode(now.params).voltage == 55, "data counts although a bit is set"
        bus.inject("voltage", "11.1")
        assert (await host.status(p.ping(1))).code == 0
        bus.inject("voltage", "source")
        assert (await host.status(p.ping(1))).code == Alarm.VOLTAGE

    on_wire(test, voltage=lambda _: volts[0])


def test_a_frozen_sensor_repeats_itself():
    async def test(bus: Ax12Bus, host: Host, clock) -> None:
        bus.inject("freeze", "1", "on")
        await host.status(write(1, p.TORQUE_ENABLE, 1))
        await host.status(write(1, p.GOAL_POSITION, 600))
        await clock.sleep(1)
        assert (await present(host)).position == 512
        bus.inject("freeze", "1", "off")
        assert (await present(host)).position == pytest.approx(599, abs=1)

    on_wire(test)


def test_the_past_of_a_shaft_can_be_asked_for():
    async def test(bus: Ax12Bus, host: Host, clock) -> None:
        await host.status(write(1, p.TORQUE_ENABLE, 1))
        await host.status(write(1, p.MOVING_SPEED, 200))
        await host.status(write(1, p.GOAL_POSITION, 900))
        start = clock.now()
        seen = [bus.angle(1, start + i * SECOND // 100) for i in range(10)]
        await clock.sleep(0.5)
        await present(host)
        again = bus.angles(1, start + np.arange(10) * SECOND // 100)
        assert again == pytest.approx(np.array(seen), abs=1e-4)

    on_wire(test)


@pytest.mark.parametrize(
    ("fault", "message"),
    [
        (("nonsense",), r"unknown fault 'nonsense'; known: power on\|off, "),
        (("block", "1"), r"expected 'block ID on\|off', got 'block 1'"),
        (("block",), "expected 'block ID"),
        (("vanish", "x"), "expected 'vanish ID', got 'vanish x'"),
        (("voltage", "much"), "expected 'voltage VOLTS"),
        (("late",), "expected 'late SECONDS"),
        (("power",), r"expected 'power on\|off', got 'power'"),
    ],
)
def test_bad_faults_are_refused_with_what_was_expected(fault: tuple[str, ...], message: str):
    async def test(bus: Ax12Bus, _host, _clock) -> None:
        with pytest.raises(InputError, match=message):
            bus.inject(*fault)

    on_wire(test)


def test_a_fault_of_a_unit_that_is_not_there():
    async def test(bus: Ax12Bus, _host, _clock) -> None:
        with pytest.raises(InputError, match=r"no unit 5; expected one of \[1, 2\]"):
            bus.inject("vanish", "5")
        with pytest.raises(InputError, match="no unit 5"):
            bus.angle(5, SECOND)

    on_wire(test)
