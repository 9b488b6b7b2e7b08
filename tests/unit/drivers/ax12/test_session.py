"""One exchange: what is retried, what is refused, whose answers count."""

import asyncio
import contextlib
from collections.abc import AsyncIterator

import pytest

from monstertruck_drivers.ax12 import protocol as p
from monstertruck_drivers.ax12.protocol import Alarm, Packet
from monstertruck_drivers.ax12.session import Ax12Session
from monstertruck_drivers.cable import MemoryPort
from monstertruck_runtime.clock import SECOND, VirtualClock, run_virtual
from monstertruck_runtime.errors import DeviceTimeoutError, ProtocolError
from tests.unit.drivers.kit import background


class Script:
    """Device that gives prepared answers, one per request."""

    def __init__(self, port: MemoryPort, answers: list[bytes]) -> None:
        self.requests: list[bytes] = []
        self._port = port
        self._answers = answers

    def say(self, data: bytes) -> None:
        self._port.device.write(data)

    async def run(self) -> None:
        while True:
            self.requests.append(await self._port.device.read())
            if self._answers:
                self.say(self._answers.pop(0))


def scripted(answers: list[bytes], test, *, echo: bool = False) -> None:
    """Run ``test(session, script, clock)`` against prepared answers."""

    @contextlib.asynccontextmanager
    async def ready(clock: VirtualClock) -> AsyncIterator[tuple[Ax12Session, Script]]:
        port = MemoryPort("/dev/test")
        port.plug()
        script = Script(port, answers)
        async with background(script.run()), await port.open() as link:
            session = Ax12Session(link, clock, lambda size, baud: 0.005)
            session.echo = echo
            yield session, script

    async def main(clock: VirtualClock) -> None:
        async with ready(clock) as (session, script):
            await test(session, script, clock)

    run_virtual(main)


def status(error: int = 0, data: bytes = b"", unit: int = 1) -> bytes:
    return Packet(unit, error, data).encode()


def test_a_request_that_arrived_damaged_is_sent_again():
    async def test(session: Ax12Session, script: Script, _clock) -> None:
        assert await session.write(1, p.LED, b"\x01") == Alarm.VOLTAGE
        assert (await session.read(1, p.LED, 1)).data == b"\x01"
        assert len(script.requests) == 4

    damaged = status(Alarm.CHECKSUM)
    scripted([damaged, status(Alarm.VOLTAGE), damaged, status(0, b"\x01")], test)


def test_a_refused_write_is_an_error_that_names_its_bits():
    async def test(session: Ax12Session, script: Script, _clock) -> None:
        with pytest.raises(ProtocolError, match=r"/dev/test: unit 1 refused a write to 30: angle\+range error"):
            await session.write(1, p.GOAL_POSITION, b"\x00\x00")
        with pytest.raises(ProtocolError, match="checksum error"):
            await session.write(1, p.LED, b"\x01")
        assert len(script.requests) == 4

    scripted([status(Alarm.ANGLE | Alarm.RANGE), *[status(Alarm.CHECKSUM)] * 3], test)


def test_an_answer_without_its_data_is_an_error():
    async def test(session: Ax12Session, _script, _clock) -> None:
        with pytest.raises(ProtocolError, match="unit 1 gave no data: range error"):
            await session.read(1, p.PUNCH, 8)

    scripted([status(Alarm.RANGE)], test)


def test_answers_of_others_and_of_other_lengths_do_not_count():
    async def test(session: Ax12Session, _script, _clock) -> None:
        assert (await session.read(1, p.PRESENT_POSITION, 8)).data == bytes(range(8))

    late = status(0, bytes(12))
    scripted([status(0, bytes(8), unit=2) + late + b"\xff\x00" + status(0, bytes(range(8)))], test)


def test_an_answer_that_came_too_late_is_thrown_away():
    async def test(session: Ax12Session, script: Script, clock) -> None:
        with pytest.raises(DeviceTimeoutError):
            await session.read(1, p.PRESENT_POSITION, 8, retries=0)
        script.say(status(0, bytes(8)))
        await clock.sleep(0.01)
        assert (await session.read(1, p.PRESENT_POSITION, 8)).data == bytes(range(8))

    scripted([b"", status(), status(0, bytes(range(8)))], test)


@pytest.mark.parametrize("delayed", [0.001, 0.004, 0.006, 0.009])
def test_a_late_answer_of_the_same_size_is_not_taken_for_the_next_one(delayed: float):
    """It gave the old position a new stamp."""

    async def test(session: Ax12Session, script: Script, clock: VirtualClock) -> None:
        old, new = status(0, bytes(8)), status(0, bytes(range(8)))
        with pytest.raises(DeviceTimeoutError):
            await session.read(1, p.PRESENT_POSITION, 8, retries=0)
        loop = asyncio.get_running_loop()
        for nth, answer in enumerate((old, status(), new, status(), new, status(), new)):
            loop.call_later(delayed + 0.0005 * nth, script.say, answer)
        with contextlib.suppress(DeviceTimeoutError):
            assert (await session.read(1, p.PRESENT_POSITION, 8)).data == bytes(range(8))

    scripted([], test)


def test_a_unit_that_is_behind_keeps_no_other_waiting_and_is_in_step_after_a_ping():
    async def test(session: Ax12Session, script: Script, _clock) -> None:
        with pytest.raises(DeviceTimeoutError):
            await session.read(1, p.PRESENT_POSITION, 8, retries=0)
        await session.read(2, p.PRESENT_POSITION, 8)
        assert (await session.read(1, p.PRESENT_POSITION, 8)).data == bytes(range(8))
        await session.read(1, p.PRESENT_POSITION, 8)
        assert [request[4] for request in script.requests] == [2, 2, p.Instruction.PING, 2, 2]

    late = status(0, bytes(8))
    scripted([b"", status(0, bytes(8), 2), late + status(), status(0, bytes(range(8))), late], test)


def test_silence_is_asked_three_times():
    async def test(session: Ax12Session, script: Script, clock) -> None:
        start = clock.now()
        with pytest.raises(DeviceTimeoutError, match="unit 1: no correct answer"):
            await session.ping(1)
        assert clock.now() - start == pytest.approx(0.015 * SECOND, abs=1000)
        assert script.requests == [p.ping(1)] * 3
        with pytest.raises(DeviceTimeoutError):
            await session.ping(1, retries=0)
        assert len(script.requests) == 4

    scripted([], test)


def test_an_echo_is_dropped_once():
    async def test(session: Ax12Session, _script, _clock) -> None:
        assert await session.ping(1) == Alarm.VOLTAGE, "the answer looks like the ping itself"
        with pytest.raises(DeviceTimeoutError):
            await session.ping(1, retries=0)

    scripted([p.ping(1) + p.ping(1), p.ping(1)], test, echo=True)


@pytest.mark.parametrize(("answer", "echo"), [(status(0, bytes(3)), False), (None, True)])
def test_an_echo_is_found_by_a_request_no_answer_resembles(answer: bytes | None, echo: bool):
    request = p.read(1, p.MODEL_NUMBER, 3)

    async def test(session: Ax12Session, script: Script, _clock) -> None:
        await session.find_echo(1, 2)
        assert session.echo is echo
        assert script.requests == [request]

    scripted([answer or request], test)


def test_after_a_sync_write_the_bus_gets_a_pause():
    async def test(session: Ax12Session, script: Script, clock) -> None:
        start = clock.now()
        await session.sync_write(p.GOAL_POSITION, {1: b"\x00\x01"})
        assert clock.now() == start
        await session.ping(1)
        assert 210_000 <= clock.now() - start < 220_000, "11 bytes at 1 Mbaud, and a gap of 0.1 ms"
        assert [request[4] for request in script.requests] == [p.Instruction.SYNC_WRITE, p.Instruction.PING]

    scripted([b"", status()], test)
