"""The emulated controller: handshake, refusals and power states, bullet by bullet."""

import pytest

from monstertruck_drivers.epos import objects as od
from monstertruck_drivers.epos.emulator import EposEmulator
from monstertruck_drivers.epos.exchange import Exchanger, ObjectError
from monstertruck_drivers.epos.protocol import (
    Control,
    Frame,
    State,
    answer,
    read_request,
    write_request,
)
from monstertruck_drivers.link import Link
from monstertruck_runtime.clock import SECOND, VirtualClock
from tests.unit.drivers.epos.rig import ask, control, enable, heard, on_cable, on_line, state

STATUS = read_request(od.STATUSWORD, 1)


# The exact byte handshake


def test_handshake_byte_by_byte():
    async def test(emulator: EposEmulator, link: Link, clock: VirtualClock) -> None:
        body = await ask(link, clock, STATUS)
        assert body == answer(0, 0x1340, 0).body  # switch-on disabled, remote, speed 0
        assert emulator.frames[-1][1] == STATUS
        received = b"".join(data for _, data in emulator.received)
        assert received.startswith(bytes.fromhex("10 01 41 60 00 01 AB F0 4F"))

    on_cable(test)


def test_one_byte_at_a_time_is_the_same():
    async def test(emulator: EposEmulator, link: Link, clock: VirtualClock) -> None:
        link.write(STATUS.head)
        assert await link.exactly(1) == b"O"
        for byte in STATUS.body:
            await clock.sleep(0.4)
            link.write(bytes((byte,)))
        assert await link.exactly(2) == b"O\0"

    on_cable(test)


def test_without_the_hosts_ready_there_is_no_answer():
    async def test(emulator: EposEmulator, link: Link, clock: VirtualClock) -> None:
        link.write(STATUS.head)
        await link.exactly(1)
        link.write(STATUS.body)
        await link.exactly(2)
        link.write(b"F")
        assert await heard(link, clock, 0.05) == b""
        assert len(await ask(link, clock, STATUS)) == 11

    on_cable(test)


# Refusals


def test_busy_is_refused():
    async def test(emulator: EposEmulator, link: Link, clock: VirtualClock) -> None:
        emulator.inject("busy", "2")
        for _ in range(2):
            link.write(STATUS.head)
            assert await heard(link, clock, 0.05) == b"F"
        assert len(await ask(link, clock, STATUS)) == 11

    on_cable(test)


def test_a_wrong_checksum_is_refused():
    async def test(emulator: EposEmulator, link: Link, clock: VirtualClock) -> None:
        link.write(STATUS.head)
        await link.exactly(1)
        link.write(STATUS.body[:-1] + b"\0")
        assert await heard(link, clock, 0.05) == b"F"
        assert len(await ask(link, clock, STATUS)) == 11
        emulator.inject("refuse", "1")
        link.write(STATUS.head + STATUS.body)
        assert await heard(link, clock, 0.05) == b"OF"

    on_cable(test)


def test_a_half_frame_is_dropped_silently_after_500_ms():
    async def test(emulator: EposEmulator, link: Link, clock: VirtualClock) -> None:
        link.write(STATUS.head + STATUS.body[:4])
        assert await heard(link, clock, 0.6) == b"O"
        assert len(await ask(link, clock, STATUS)) == 11
        link.write(STATUS.head + STATUS.body[:4])
        await clock.sleep(0.4)
        link.write(STATUS.head)  # too early: swallowed as part of the frame
        assert await heard(link, clock, 0.4) == b"O"

    on_cable(test)


@pytest.mark.parametrize(
    ("request_frame", "code"),
    [
        (Frame(0x7F, (1, 2)), od.ILLEGAL_COMMAND),
        (Frame(0x10, (1, 2, 3)), od.ILLEGAL_COMMAND),
        (Frame(0x10, (0x5555, 0x0100)), od.NO_OBJECT),
        (Frame(0x10, (0x2003, 0x0109)), od.NO_SUBINDEX),
        (Frame(0x10, (0x6041, 0x0200)), od.WRONG_NODE),
        (Frame(0x10, (0x2004, 0x0100)), od.LENGTH_MISMATCH),
        (Frame(0x11, (0x6041, 0x0100, 0, 0)), od.WRITE_OF_READ_ONLY),
        (write_request(od.MODE, 99, 1), od.TOO_HIGH),
        (write_request(od.MODE, -99, 1), od.TOO_LOW),
        (write_request(od.ERROR_COUNT, 1, 1), od.TOO_HIGH),
        (write_request(od.STORE, 1, 1), od.CANNOT_STORE),
        (write_request(od.RESTORE, 1, 1), od.CANNOT_STORE),
    ],
)
def test_refused_requests(request_frame: Frame, code: int):
    async def test(emulator: EposEmulator, link: Link, clock: VirtualClock) -> None:
        assert await ask(link, clock, request_frame) == answer(code).body

    on_cable(test)


def test_node_0_is_whoever_is_there():
    async def test(emulator: EposEmulator, link: Link, clock: VirtualClock) -> None:
        assert len(await ask(link, clock, read_request(od.STATUSWORD, 0))) == 11

    on_cable(test)


# State machine


def test_bring_up_passes_refresh_and_measure_init_for_100_to_300_ms():
    async def test(emulator: EposEmulator, line: Exchanger, clock: VirtualClock) -> None:
        assert await state(line) is State.SWITCH_ON_DISABLED
        await control(line, Control.SHUTDOWN)
        assert await state(line) is State.READY
        for word, passing, arrived in (
            (Control.SWITCH_ON, State.REFRESH, State.SWITCHED_ON),
            (Control.ENABLE, State.MEASURE_INIT, State.ENABLED),
        ):
            await control(line, word)
            start = clock.now()
            while (now := await state(line)) is passing:
                await clock.sleep(0.001)
            assert now is arrived
            assert 0.1 < (clock.now() - start) / SECOND < 0.31
        await control(line, Control.SWITCH_ON)
        assert await state(line) is State.SWITCHED_ON
        await control(line, Control.SHUTDOWN)
        assert await state(line) is State.READY
        await control(line, Control.QUICK_STOP)
        assert await state(line) is State.SWITCH_ON_DISABLED

    on_line(test)


def test_impossible_controlwords_are_ignored_or_refused():
    async def test(emulator: EposEmulator, line: Exchanger, clock: VirtualClock) -> None:
        await control(line, Control.SWITCH_ON, Control.ENABLE)
        assert await state(line) is State.SWITCH_ON_DISABLED
        emulator.inject("strict", "on")
        with pytest.raises(ObjectError, match="wrong device state"):
            await control(line, Control.ENABLE)
        await control(line, Control.QUICK_STOP, Control.DISABLE_VOLTAGE)

    on_line(test)


def test_quick_stop_brakes_and_enable_resumes():
    async def test(emulator: EposEmulator, line: Exchanger, clock: VirtualClock) -> None:
        await line.write(od.QUICK_STOP_DECELERATION, 50_000)
        await line.write(od.ACCELERATION, 50_000)
        await enable(line, clock, 5000)
        await clock.sleep(0.3)
        assert await line.read(od.VELOCITY_AVERAGED) == 5000
        await control(line, Control.QUICK_STOP)
        assert await state(line) is State.QUICK_STOP
        await clock.sleep(0.11)
        assert await line.read(od.VELOCITY_DEMAND) == 0
        assert await state(line) is State.QUICK_STOP
        await control(line, Control.ENABLE)
        await clock.sleep(0.11)
        assert await line.read(od.VELOCITY_DEMAND) == 5000, "the target is remembered: the host must clear it"
        await control(line, Control.HALT)
        await clock.sleep(0.6)
        assert await state(line) is State.ENABLED
        assert await line.read(od.VELOCITY_DEMAND) == 0
        await control(line, Control.QUICK_STOP)
        await control(line, Control.SHUTDOWN)
        assert await state(line) is State.QUICK_STOP, "only enable or power off leave it"

    on_line(test)
