"""The emulated controller moves, faults, loses its power and its host."""

import asyncio
from functools import partial

import numpy as np
import pytest

from monstertruck_drivers.emulation import MotorReading
from monstertruck_drivers.epos import objects as od
from monstertruck_drivers.epos.emulator import EposEmulator
from monstertruck_drivers.epos.exchange import Exchanger
from monstertruck_drivers.epos.firmware import Firmware, FreeMotor
from monstertruck_drivers.epos.objects import ObjectEntry
from monstertruck_drivers.epos.protocol import (
    READY,
    Control,
    Frame,
    NmtCommand,
    Opcode,
    State,
    read_request,
)
from monstertruck_drivers.link import Link
from monstertruck_runtime.clock import SECOND, VirtualClock
from monstertruck_runtime.errors import InputError
from tests.unit.drivers.epos.rig import ask, control, enable, heard, on_cable, on_line, state

STATUS = read_request(od.STATUSWORD, 1)


# Motion


def test_ramps_and_target_reached():
    async def test(emulator: EposEmulator, line: Exchanger, clock: VirtualClock) -> None:
        await line.write(od.ACCELERATION, 5_000)
        await line.write(od.DECELERATION, 20_000)
        await enable(line, clock)
        start = clock.now()
        await line.write(od.TARGET_VELOCITY, 10_000)
        await clock.sleep(1.0)
        elapsed = (clock.now() - start) / SECOND
        assert await line.read(od.VELOCITY_DEMAND) == pytest.approx(5_000 * elapsed, abs=30)
        assert not await line.read(od.STATUSWORD) & 1 << 10
        await clock.sleep(1.1)
        assert await line.read(od.STATUSWORD) & 1 << 10
        await line.write(od.TARGET_VELOCITY, 0)
        assert not await line.read(od.STATUSWORD) & 1 << 10
        await clock.sleep(0.5)
        assert await line.read(od.VELOCITY_DEMAND) == 0
        assert await line.read(od.STATUSWORD) & 1 << 12

    on_line(test)


def test_the_target_is_limited_and_needs_the_mode():
    async def test(emulator: EposEmulator, line: Exchanger, clock: VirtualClock) -> None:
        await line.write(od.MAX_VELOCITY, 4_000)
        await line.write(od.ACCELERATION, 100_000)
        await enable(line, clock, -9_000)
        assert await line.read(od.VELOCITY_DEMAND) == -4_000
        await line.write(od.MODE, 1)
        await clock.sleep(0.5)
        assert await line.read(od.VELOCITY_DEMAND) == 0
        assert await line.read(od.MODE_DISPLAY) == 1

    on_line(test)


def test_position_integrates():
    async def test(emulator: EposEmulator, line: Exchanger, clock: VirtualClock) -> None:
        await line.write(od.ACCELERATION, 100_000)
        await enable(line, clock, 6_000)
        await clock.sleep(0.2)
        then, before = clock.now(), await line.read(od.POSITION)
        await clock.sleep(1.0)
        now, after = clock.now(), await line.read(od.POSITION)
        assert after - before == pytest.approx(6_000 / 60 * 2_000 * (now - then) / SECOND, abs=10)

    on_line(test)


class StillMotor:
    """A shaft wherever a test wants it."""

    def __init__(self) -> None:
        self.turns = 0.0
        self.rpm = 0.0
        self.supply_v = 24.0
        self.commands: list[tuple[float | None, float]] = []

    def command(self, time_ns: int, target_rpm: float | None, accel_rpm_s: float) -> None:
        self.commands.append((target_rpm, accel_rpm_s))

    def reading(self, time_ns: int) -> MotorReading:
        return MotorReading(self.turns, self.rpm, self.rpm, 250.0, self.supply_v)


def at(instant: list[int]) -> int:
    return instant[0]


def get(firmware: Firmware, entry: ObjectEntry) -> int:
    return entry.decode(firmware.read(entry.index, entry.sub))


def test_position_wraps_at_32_bits_and_starts_at_0():
    motor = StillMotor()
    motor.turns = 77.0
    firmware = Firmware(lambda: SECOND, motor, np.random.default_rng(0))
    assert get(firmware, od.POSITION) == 0
    motor.turns += 2**31 / 2000
    assert get(firmware, od.POSITION) == -(2**31)
    motor.turns -= 1 / 2000
    assert get(firmware, od.POSITION) == 2**31 - 1


def test_averaged_velocity_lags_and_is_smoother():
    now, motor = [SECOND], StillMotor()
    firmware = Firmware(partial(at, now), motor, np.random.default_rng(0))
    motor.rpm = 1000.0
    series = []
    for _ in range(40):
        now[0] += SECOND // 200
        motor.turns += motor.rpm / 60 / 200
        series.append((get(firmware, od.VELOCITY), get(firmware, od.VELOCITY_AVERAGED)))
    actual, averaged = zip(*series, strict=True)
    assert averaged[0] < 300, "it lags"
    assert set(averaged[-5:]) == {1000}
    assert len(set(actual)) > 1, "one count in 1 ms is 30 rpm"
    assert all(abs(value - 1000) <= 30 for value in actual)


def test_current_is_noisy_and_seeded():
    def series(seed: int) -> list[int]:
        firmware = Firmware(lambda: SECOND, StillMotor(), np.random.default_rng(seed))
        return [get(firmware, od.CURRENT) for _ in range(200)]

    values = np.array(series(1))
    assert values.mean() == pytest.approx(250, abs=3)
    assert values.std() == pytest.approx(8, abs=2)
    assert series(1) == series(1) != series(2)


def test_the_plant_gets_ramp_coast_and_brake():
    motor = StillMotor()
    firmware = Firmware(lambda: SECOND, motor, np.random.default_rng(0))
    assert motor.commands[-1] == (None, 0.0)
    firmware.write(0x6060, 0, 3)
    firmware.write(0x60FF, 0, 700)
    firmware.state = State.SWITCHED_ON
    firmware._set(State.ENABLED)
    assert motor.commands[-1] == (700.0, 10_000.0)
    firmware.write(0x6040, 0, Control.QUICK_STOP)
    assert motor.commands[-1] == (0.0, 10_000.0)
    firmware.write(0x6040, 0, Control.DISABLE_VOLTAGE)
    assert motor.commands[-1] == (None, 0.0)


# Faults


@pytest.mark.parametrize(
    ("name", "code"),
    [
        ("over_voltage", 0x3210),
        ("under_voltage", 0x3220),
        ("over_current", 0x2310),
        ("encoder", 0x7320),
        ("following", 0x8611),
        ("FF0B", 0xFF0B),
    ],
)
def test_faults_by_command_stop_the_motor_and_are_remembered(name: str, code: int):
    async def test(emulator: EposEmulator, line: Exchanger, clock: VirtualClock) -> None:
        await line.write(od.ACCELERATION, 100_000)
        await enable(line, clock, 1_000)
        emulator.inject("fault", name)
        assert await state(line) is State.FAULT_REACTION_ENABLED
        await clock.sleep(0.06)
        assert await state(line) is State.FAULT
        assert await line.read(od.ERROR_REGISTER) & 1
        assert await line.read(od.ERROR_COUNT) == 1
        assert await line.read(od.ERROR_HISTORY[0]) == code
        assert await line.read(od.ERROR_HISTORY[1]) == 0
        await clock.sleep(0.3)
        assert await line.read(od.VELOCITY_DEMAND) == 0

    on_line(test)


def test_history_is_newest_first_and_can_be_cleared():
    async def test(emulator: EposEmulator, line: Exchanger, clock: VirtualClock) -> None:
        for code in range(0xFF01, 0xFF08):
            emulator.inject("fault", f"{code:X}", "passing")
        assert await line.read(od.ERROR_COUNT) == 5
        assert [await line.read(entry) for entry in od.ERROR_HISTORY] == [0xFF07, 0xFF06, 0xFF05, 0xFF04, 0xFF03]
        await line.write(od.ERROR_COUNT, 0)
        assert await line.read(od.ERROR_HISTORY[0]) == 0

    on_line(test)


def test_reset_needs_an_edge_and_the_cause_gone():
    async def test(emulator: EposEmulator, line: Exchanger, clock: VirtualClock) -> None:
        emulator.inject("fault", "over_current")
        await clock.sleep(0.06)
        await control(line, Control.DISABLE_VOLTAGE, Control.FAULT_RESET)
        assert await state(line) is State.FAULT, "the cause is there"
        emulator.inject("clear")
        await control(line, Control.FAULT_RESET)
        assert await state(line) is State.FAULT, "no edge"
        await control(line, Control.SHUTDOWN)
        assert await state(line) is State.FAULT, "not the reset bit"
        await control(line, Control.FAULT_RESET)
        assert await state(line) is State.SWITCH_ON_DISABLED
        assert await line.read(od.ERROR_REGISTER) == 0
        assert await line.read(od.ERROR_COUNT) == 1, "history stays"

    on_line(test)


def test_a_full_battery_may_be_over_voltage_and_an_empty_one_under_voltage():
    motor = FreeMotor(25.2)

    async def test(emulator: EposEmulator, line: Exchanger, clock: VirtualClock) -> None:
        assert await state(line) is State.SWITCH_ON_DISABLED
        emulator.inject("supply_limit", "25.0")
        await clock.sleep(0.15)  # nobody asks: it notices by itself
        assert emulator.state is State.FAULT
        assert await line.read(od.ERROR_HISTORY[0]) == od.OVER_VOLTAGE
        await control(line, Control.DISABLE_VOLTAGE, Control.FAULT_RESET)
        assert await state(line) is State.FAULT
        motor.supply_v = 24.5
        await control(line, Control.DISABLE_VOLTAGE, Control.FAULT_RESET)
        assert await state(line) is State.SWITCH_ON_DISABLED
        motor.supply_v = 8.9
        await clock.sleep(0.15)
        assert await line.read(od.ERROR_HISTORY[0]) == od.UNDER_VOLTAGE

    on_line(test, motor=motor)


# Power, host, cable


def test_without_power_it_is_silent_and_returns_disabled_with_target_0():
    motor = FreeMotor()

    async def test(emulator: EposEmulator, line: Exchanger, clock: VirtualClock) -> None:
        await line.write(od.ACCELERATION, 30_000)
        await line.write(od.STORE, od.SAVE)
        await line.write(od.DECELERATION, 30_000)
        await enable(line, clock, 3_000)
        await clock.sleep(0.2)
        emulator.inject("power", "off")
        with pytest.raises(Exception, match="no answer within"):
            await line.read(od.STATUSWORD)
        await clock.sleep(0.3)
        assert motor.reading(clock.now()).rpm == 0, "it coasted"
        emulator.inject("power", "on")
        assert await line.read(od.STATUSWORD, attempts=2) == 0x1340, "after some boot time"
        assert await line.read(od.TARGET_VELOCITY) == 0
        assert await line.read(od.POSITION) == 0
        assert await line.read(od.MODE) == 1
        assert await line.read(od.ACCELERATION) == 30_000, "stored"
        assert await line.read(od.DECELERATION) == 10_000, "not stored"
        await line.write(od.RESTORE, od.LOAD)
        emulator.power_cycle()
        assert await line.read(od.ACCELERATION, attempts=2) == 10_000

    on_line(test, motor=motor)


def test_power_lost_in_the_middle_of_an_exchange_ends_it():
    async def test(emulator: EposEmulator, link: Link, clock: VirtualClock) -> None:
        link.write(STATUS.head)
        await link.exactly(1)
        link.write(STATUS.body)
        emulator.power_cycle()
        assert await heard(link, clock, 0.5) == b""
        assert len(await ask(link, clock, STATUS)) == 11

    on_cable(test)


def test_network_reset_restarts_it_without_an_answer():
    async def test(emulator: EposEmulator, link: Link, clock: VirtualClock) -> None:
        async def send(command: NmtCommand) -> None:
            request = Frame(Opcode.NMT, (1, command))
            link.write(request.head)
            await link.exactly(1)
            link.write(request.body)
            assert await heard(link, clock, 0.5) == bytes((READY,))

        line = Exchanger(link, clock, 1)
        await line.write(od.ACCELERATION, 30_000)
        await send(NmtCommand.START)
        assert await line.read(od.ACCELERATION) == 30_000
        await send(NmtCommand.RESET_NODE)
        assert await line.read(od.ACCELERATION) == 10_000

    on_cable(test)


def test_it_keeps_its_speed_when_the_host_dies():
    motor = FreeMotor()

    async def test(emulator: EposEmulator, line: Exchanger, clock: VirtualClock) -> None:
        await line.write(od.ACCELERATION, 100_000)
        await enable(line, clock, 2_000)
        await clock.sleep(60)
        assert motor.reading(clock.now()).rpm == 2_000

    on_line(test, motor=motor)


def test_the_deadman_line_stops_it_without_any_host():
    motor = FreeMotor()

    async def test(emulator: EposEmulator, line: Exchanger, clock: VirtualClock) -> None:
        for entry in (od.ACCELERATION, od.QUICK_STOP_DECELERATION):
            await line.write(entry, 100_000)
        await enable(line, clock, 18_000)
        await clock.sleep(0.2)
        emulator.set_quick_stop_input(True)
        await clock.sleep(0.2)
        assert motor.reading(clock.now()).rpm == 0
        assert await state(line) is State.QUICK_STOP
        assert await line.read(od.DIGITAL_INPUTS) == od.QUICK_STOP_INPUT
        await control(line, Control.ENABLE)
        assert await state(line) is State.QUICK_STOP, "the line wins"
        await control(line, Control.DISABLE_VOLTAGE, Control.SHUTDOWN)
        assert await state(line) is State.SWITCH_ON_DISABLED
        emulator.inject("line", "off")
        await control(line, Control.SHUTDOWN)
        assert await state(line) is State.READY
        emulator.inject("line", "on")
        assert await state(line) is State.SWITCH_ON_DISABLED

    on_line(test, motor=motor)


@pytest.mark.parametrize("milliseconds", [5, 50, 600])
def test_late_answers(milliseconds: int):
    async def test(emulator: EposEmulator, link: Link, clock: VirtualClock) -> None:
        emulator.inject("delay", str(milliseconds), "1")
        link.write(STATUS.head)
        await link.exactly(1)
        link.write(STATUS.body)
        assert await link.exactly(1) == b"O"
        start = clock.now()
        assert await link.exactly(1) == b"\0"
        assert (clock.now() - start) / SECOND == pytest.approx(milliseconds / 1000, abs=0.002)

    on_cable(test)


def test_flipped_bit_and_repetition():
    async def test(emulator: EposEmulator, link: Link, clock: VirtualClock) -> None:
        right = await ask(link, clock, STATUS)
        for repeats in ("off", "on"):
            emulator.inject("repeat", repeats)
            emulator.inject("flip", "1")
            link.write(STATUS.head)
            await link.exactly(1)
            link.write(STATUS.body)
            await link.exactly(2)
            link.write(b"O")
            wrong = await link.exactly(11)
            assert sum(a != b for a, b in zip(right, wrong, strict=True)) == 1
            link.write(b"F")
            assert await heard(link, clock, 0.05) == (right if repeats == "on" else b"")
            await clock.sleep(0.6)

    on_cable(test)


def test_stray_byte_before_the_acknowledge():
    async def test(emulator: EposEmulator, link: Link, clock: VirtualClock) -> None:
        emulator.inject("stray", "1")
        link.write(STATUS.head)
        assert await heard(link, clock, 0.05) == b"\xa5O"

    on_cable(test)


def test_silence_by_command():
    async def test(emulator: EposEmulator, link: Link, clock: VirtualClock) -> None:
        emulator.inject("silent", "on")
        link.write(STATUS.head)
        assert await heard(link, clock, 1.0) == b""
        emulator.inject("silent", "off")
        assert len(await ask(link, clock, STATUS)) == 11

    on_cable(test)


def test_an_exchange_at_38400_baud_takes_6_to_13_ms():
    async def test(emulator: EposEmulator, line: Exchanger, clock: VirtualClock) -> None:
        line._link._transmit.__self__.baud = 38_400  # type: ignore[attr-defined]
        for access in (partial(line.read, od.POSITION), partial(line.write, od.TARGET_VELOCITY, 5)):
            start = clock.now()
            await access()
            assert 0.0063 < (clock.now() - start) / SECOND < 0.013

    on_line(test)


@pytest.mark.parametrize(
    ("fault", "message"),
    [
        (("explode",), "unknown fault 'explode'; known: fault CODE"),
        (("busy", "many"), r"expected 'busy \[COUNT\]', got 'busy many'"),
        (("power", "maybe"), r"expected 'power on\|off', got 'power maybe'"),
        (("fault", "over_voltage", "twice"), "expected 'fault CODE"),
        (("fault", "zzzz"), "expected 'fault CODE"),
        (("clear", "all"), "expected 'clear"),
    ],
)
def test_bad_injections_are_refused(fault: tuple[str, ...], message: str):
    async def test(emulator: EposEmulator, link: Link, clock: VirtualClock) -> None:
        with pytest.raises(InputError, match=message):
            emulator.inject(*fault)

    on_cable(test)


def test_garbage_never_kills_it():
    async def test(emulator: EposEmulator, link: Link, clock: VirtualClock) -> None:
        rng = np.random.default_rng(3)
        for _ in range(200):
            link.write(rng.bytes(int(rng.integers(1, 40))))
            await asyncio.sleep(0.01)
        await clock.sleep(0.6)
        link.discard()
        assert len(await ask(link, clock, STATUS)) == 11

    on_cable(test)
