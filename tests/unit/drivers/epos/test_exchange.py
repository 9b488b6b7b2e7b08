"""The host's half of the handshake: time-outs, damage, recovery, cancellation."""

import asyncio
from collections.abc import Awaitable, Callable, Coroutine
from typing import Any

import pytest

from monstertruck_drivers.epos import objects as od
from monstertruck_drivers.epos.emulator import EposEmulator
from monstertruck_drivers.epos.exchange import QUICK_ANSWER, QUIET, RECENT, Exchanger, ObjectError, _HeldUpError
from monstertruck_drivers.epos.protocol import ObjectSegment, answer, segment_request
from monstertruck_drivers.link import Link
from monstertruck_runtime.clock import SECOND, VirtualClock, VirtualLoop, run_virtual
from monstertruck_runtime.errors import DeviceLostError, DeviceTimeoutError, ProtocolError
from tests.unit.drivers.epos.rig import on_line

HELD_BACK = 0.01

DISABLED = 0x1340
O, F = b"O", b"F"  # noqa: E741
ANSWER = answer(0, DISABLED, 0).body
WRITTEN = answer(0).body
QUICK = 50_000_000
"""``QUICK_ANSWER``, ns."""


class Peer:
    """A device that says what a script says: each host write is met by the next reply."""

    def __init__(self, clock: VirtualClock) -> None:
        self.written: list[tuple[float, bytes]] = []
        self.replies: list[bytes] = []
        self.stand_still_before: int | None = None
        """Number of the reply before which the host's process does not run for 1.5 s."""
        self.on_refusal: Callable[[], None] | None = None
        """Called when the host refuses an answer."""
        self._clock = clock
        self.link = Link("peer", self._take, lambda: None)

    def _take(self, data: bytes) -> None:
        self.written.append((self._clock.now() / SECOND - 1, data))
        if len(self.written) - 1 == self.stand_still_before:
            asyncio.get_running_loop().call_soon(self._stand_still)
        elif data == F and self.on_refusal is not None:
            self.on_refusal()
        elif self.replies:
            self.link.feed(self.replies.pop(0))

    def _stand_still(self) -> None:
        loop = asyncio.get_running_loop()
        assert isinstance(loop, VirtualLoop)
        loop.jump(1.5)
        self.link.feed(self.replies.pop(0))


def with_peer(*replies: bytes) -> Callable[[Callable[[Peer, Exchanger], Coroutine[Any, Any, None]]], None]:
    """Run ``test(peer, line)`` against scripted replies."""

    def run(test: Callable[[Peer, Exchanger], Coroutine[Any, Any, None]]) -> None:
        async def main(clock: VirtualClock) -> None:
            peer = Peer(clock)
            peer.replies = list(replies)
            line = Exchanger(peer.link, clock, 1)
            try:
                await test(peer, line)
            finally:
                peer.link.close()
                await line.close()

        run_virtual(main)

    return run


async def time_of(clock: VirtualClock, act: Awaitable[Any]) -> float:
    start = clock.now()
    await act
    return (clock.now() - start) / SECOND


def test_a_row_of_objects_is_read_until_it_is_enough():
    async def test(_emulator: EposEmulator, line: Exchanger, _clock: VirtualClock) -> None:
        entries = (od.STATUSWORD, od.MODE, od.POSITION)
        whole = [await line.read(entry) for entry in entries]
        for count in (1, 2, 3):
            got: list[int] = []

            def take(value: int, got: list[int] = got, count: int = count) -> bool:
                got.append(value)
                return len(got) < count

            await line.read_row(entries, take)
            assert got == whole[:count]
        with pytest.raises(ObjectError):
            await line.read_row((od.STATUSWORD, od.ObjectEntry("nothing", 0x7FFF, 0, 16)), lambda _: True)

    on_line(test)


def test_a_row_that_nobody_waits_for_any_more_ends_with_the_exchange_that_has_begun():
    async def test(emulator: EposEmulator, line: Exchanger, clock: VirtualClock) -> None:
        got: list[int] = []
        task = asyncio.create_task(line.read_row((od.STATUSWORD, od.MODE, od.POSITION), lambda v: not got.append(v)))
        await asyncio.sleep(0)
        assert not task.done()
        task.cancel()
        await asyncio.wait([task])
        assert task.cancelled()
        await line.write(od.CONTROLWORD, 0x0002)
        assert len(got) == 1

    on_line(test)


def test_a_row_after_one_that_was_cut_short_is_read_whole():
    async def test(emulator: EposEmulator, line: Exchanger, clock: VirtualClock) -> None:
        entries = (od.STATUSWORD, od.MODE, od.POSITION)
        cut: list[int] = []
        task = asyncio.create_task(line.read_row(entries, lambda value: not cut.append(value)))
        await asyncio.sleep(0)
        await line.finish()
        await task
        assert len(cut) == 1
        got: list[int] = []
        await line.read_row(entries, lambda value: not got.append(value))
        assert len(got) == 3

    on_line(test)


def test_a_stray_byte_between_the_exchanges_of_a_row_is_dropped():
    async def test(peer: Peer, line: Exchanger) -> None:
        got: list[int] = []
        await line.read_row((od.STATUSWORD, od.STATUSWORD), lambda value: not got.append(value))
        assert got == [DISABLED, DISABLED]

    with_peer(O, O + b"\0", ANSWER, O, O, O + b"\0", ANSWER, b"")(test)


def test_the_worked_exchange():
    async def test(peer: Peer, line: Exchanger) -> None:
        assert await line.read(od.STATUSWORD) == 0x0337
        sent = [data.hex(" ").upper() for _, data in peer.written]
        assert sent == ["10", "01 41 60 00 01 AB F0", "4F", "4F"]

    with_peer(O, O + b"\0", bytes.fromhex("03 00 00 00 00 37 03 00 00 AD F6"))(test)


@pytest.mark.parametrize("step", [1, 2, 3])
def test_the_acknowledge_and_the_answer_may_come_together_or_apart(step: int):
    async def main(clock: VirtualClock) -> None:
        def drip(data: bytes) -> None:
            link.feed(data)

        def take(data: bytes) -> None:
            reply = replies.pop(0)
            for i in range(0, len(reply), step):
                asyncio.get_running_loop().call_later(0.001 * i, drip, reply[i : i + step])

        replies = [O, O + b"\0", ANSWER, b""]
        link = Link("peer", take, lambda: None)
        assert await Exchanger(link, clock, 1).read(od.STATUSWORD) == DISABLED

    run_virtual(main)


def test_object_errors_carry_their_code_and_end_the_exchange():
    async def test(emulator: EposEmulator, line: Exchanger, clock: VirtualClock) -> None:
        with pytest.raises(
            ObjectError, match=r"0x6060/0 \(mode of operation\) = 99: 0x06090031 \(value too high\)"
        ) as caught:
            await line.write(od.MODE, 99)
        assert caught.value.code == od.TOO_HIGH
        assert await time_of(clock, line.read(od.STATUSWORD)) < 0.01

    on_line(test)


@pytest.mark.parametrize("refusals", [1, 3])
def test_busy_is_asked_again_after_5_to_20_ms(refusals: int):
    async def test(emulator: EposEmulator, line: Exchanger, clock: VirtualClock) -> None:
        emulator.inject("busy", str(refusals))
        took = await time_of(clock, line.read(od.STATUSWORD))
        assert refusals * 0.005 < took < refusals * 0.02

    on_line(test)


def test_busy_for_ever_is_a_timeout_but_needs_no_silence():
    async def test(emulator: EposEmulator, line: Exchanger, clock: VirtualClock) -> None:
        emulator.inject("busy", "4")
        with pytest.raises(DeviceTimeoutError, match="stays busy"):
            await line.read(od.STATUSWORD)
        assert await time_of(clock, line.read(od.STATUSWORD)) < 0.01

    on_line(test)


def test_a_refused_frame_is_sent_once_more():
    async def test(emulator: EposEmulator, line: Exchanger, clock: VirtualClock) -> None:
        emulator.inject("refuse", "1")
        assert await time_of(clock, line.read(od.STATUSWORD)) < 0.01
        emulator.inject("refuse", "2")
        with pytest.raises(ProtocolError, match="rejected twice"):
            await line.read(od.STATUSWORD)

    on_line(test)


@pytest.mark.parametrize("repeats", ["on", "off"])
def test_a_damaged_answer_is_refused_and_read_again(repeats: str):
    async def test(emulator: EposEmulator, line: Exchanger, clock: VirtualClock) -> None:
        emulator.inject("repeat", repeats)
        emulator.inject("flip", "1")
        start = clock.now()
        assert await line.read(od.STATUSWORD) == DISABLED
        assert (clock.now() - start) / SECOND < 0.06, "no silence needed"
        assert len(emulator.frames) == (1 if repeats == "on" else 2)

    on_line(test)


def test_damage_that_stays_is_an_error():
    async def test(emulator: EposEmulator, line: Exchanger, clock: VirtualClock) -> None:
        emulator.inject("flip", "2")
        with pytest.raises(ProtocolError, match="damaged twice"):
            await line.read(od.STATUSWORD)

    on_line(test)


def test_an_impossible_length_is_damage():
    async def test(peer: Peer, line: Exchanger) -> None:
        assert await line.read(od.STATUSWORD) == DISABLED
        assert [data for _, data in peer.written][2:4] == [O, F]

    with_peer(O, O + b"\0", b"\x83" + ANSWER[1:], ANSWER)(test)


def test_a_repeated_answer_that_is_damaged_too_is_an_error():
    async def test(peer: Peer, line: Exchanger) -> None:
        with pytest.raises(ProtocolError, match="damaged too"):
            await line.read(od.STATUSWORD)

    with_peer(O, O + b"\0", ANSWER[:-1] + b"\0", ANSWER[:-1] + b"\1")(test)


@pytest.mark.parametrize("strays", [1, 2, 3])
def test_stray_bytes_before_an_acknowledge_or_an_answer_are_skipped(strays: int):
    async def test(peer: Peer, line: Exchanger) -> None:
        assert await line.read(od.STATUSWORD) == DISABLED

    junk = b"\xa5\x00\xff"[:strays]
    with_peer(junk + O, junk + O + junk.replace(b"\0", b"\1") + b"\0", ANSWER)(test)


@pytest.mark.parametrize(
    ("replies", "message"),
    [
        ((b"$C12",), "24 43 31 32 instead of an acknowledge"),
        ((O, O + b"\x55\x56\x57\x58"), "55 56 57 58 instead of an answer"),
        ((O, O + b"\0", answer().body), "answer of 2 words"),
        ((O,), "no answer within 0.1 s"),
        ((O, O), "no answer within 0.25 s"),
        ((O, O + b"\0", ANSWER[:5]), "no answer within 0.1 s"),
    ],
)
def test_wrong_answers(replies: tuple[bytes, ...], message: str):
    async def test(peer: Peer, line: Exchanger) -> None:
        with pytest.raises((DeviceTimeoutError, ProtocolError), match=message):
            await line.read(od.STATUSWORD)

    with_peer(*replies)(test)


def test_after_a_timeout_nothing_is_sent_for_550_ms():
    async def test(peer: Peer, line: Exchanger) -> None:
        with pytest.raises(DeviceTimeoutError):
            await line.read(od.STATUSWORD)
        failed = peer.written[-1][0] + 0.1
        peer.replies = [O, O + b"\0", ANSWER]
        assert await line.read(od.STATUSWORD) == DISABLED
        assert peer.written[2][0] - failed == pytest.approx(0.55, abs=0.001)

    with_peer(O, b"")(test)


@pytest.mark.parametrize(
    ("replies", "failed_before", "silence"),
    [
        ((), 0, 0.12 + QUICK_ANSWER),
        ((), 1, 0.12 + QUICK_ANSWER),
        ((), 2, QUIET),
        ((O, O), 0, QUIET),
        ((O, O + b"\0", ANSWER[:5]), 1, 0.12 + QUICK_ANSWER),
    ],
)
def test_a_controller_that_drops_half_frames_soon_needs_silence_for_a_late_answer_or_a_third_failure(
    replies: tuple[bytes, ...], failed_before: int, silence: float
):
    async def test(peer: Peer, line: Exchanger) -> None:
        line._frame_timeout, line._failures = 0.12, failed_before
        with pytest.raises((DeviceTimeoutError, ProtocolError)):
            await line.read(od.STATUSWORD)
        assert (line.quiet_until - line._clock.now()) / SECOND == pytest.approx(silence, abs=1e-6)

    with_peer(*replies)(test)


@pytest.mark.parametrize(("frame_timeout", "silence"), [(0.12, 0.12 + QUICK_ANSWER), (None, QUIET)])
def test_a_byte_into_the_silence_prolongs_it_by_what_the_controller_needs(frame_timeout: float | None, silence: float):
    """It was the silence of repeated failures: a stray byte cost 0.56 s."""

    async def test(peer: Peer, line: Exchanger) -> None:
        line._frame_timeout = frame_timeout
        with pytest.raises(DeviceTimeoutError):
            await line.read(od.STATUSWORD)
        began = line._clock.now()
        asyncio.get_running_loop().call_later(0.05, peer.link.feed, b"\x55")
        await line.settle()
        assert (line._clock.now() - began) / SECOND == pytest.approx(0.05 + silence, abs=1e-3)
        assert line.strange == b"\x55"

    with_peer()(test)


@pytest.mark.parametrize(
    ("slowest", "count", "waited", "silence"),
    [
        (QUICK, RECENT, QUICK_ANSWER, 0.05 + QUICK_ANSWER + HELD_BACK),
        (QUICK // 5, RECENT, QUICK_ANSWER, 0.05 + QUICK_ANSWER / 5 + HELD_BACK),
        (QUICK + 1, RECENT, 0.25, 0.25 + QUIET),
        (QUICK, RECENT - 1, 0.25, 0.25 + QUIET),
    ],
)
def test_an_answer_that_does_not_come_is_lost_if_all_the_newest_were_quick(
    slowest: int, count: int, waited: float, silence: float
):
    """The silence is counted from the last byte: that much of it has passed when the wait ends."""

    async def test(peer: Peer, line: Exchanger) -> None:
        line._frame_timeout = 0.05
        line.durations.extend([slowest, *[QUICK // 5] * (count - 1)])
        began = line._clock.now()
        with pytest.raises(DeviceTimeoutError):
            await line.read(od.STATUSWORD)
        assert (line._clock.now() - began) / SECOND == pytest.approx(waited, abs=1e-3)
        assert (line.quiet_until - began) / SECOND == pytest.approx(silence, abs=1e-3)
        assert line._flight is None, "nothing keeps the error and whoever waited for it"

    with_peer(O, O)(test)


@pytest.mark.parametrize(("duration", "milliseconds"), [(0.01, 50), (0.05, 50), (0.051, 120), (None, 120)])
def test_the_time_of_a_half_frame_is_set_by_how_quick_the_line_is(duration: float | None, milliseconds: int):
    async def test(peer: Peer, line: Exchanger) -> None:
        line.durations.extend([] if duration is None else [round(duration * SECOND)])
        await line.shorten_silence()
        assert peer.written[1][1][5:7] == milliseconds.to_bytes(2, "little")
        assert line._frame_timeout == milliseconds / 1000

    with_peer(O, O + b"\0", WRITTEN)(test)


def test_outside_the_schedule_an_exchange_is_tried_three_times():
    async def test(peer: Peer, line: Exchanger) -> None:
        with pytest.raises(DeviceTimeoutError):
            await line.shorten_silence()
        assert [data for _, data in peer.written] == [b"\x11"] * 3

    with_peer()(test)


def test_an_answer_of_another_length_than_a_write_has_is_damage_and_refused_once_its_rest_is_in():
    async def test(peer: Peer, line: Exchanger) -> None:
        await line.write(od.CONTROLWORD, 6)
        (noticed, refused) = [at for at, data in peer.written if data in (O, F)][:2]
        assert refused - noticed == pytest.approx(0.005, abs=1e-6)
        assert [data for _, data in peer.written].count(F) == 1

    with_peer(O, O + b"\0", ANSWER, WRITTEN, b"")(test)


@pytest.mark.parametrize(("stood", "held_up"), [(0.6, True), (0.1, False)])
def test_bytes_that_a_process_finds_after_it_stood_still_are_no_answer(stood: float, held_up: bool):
    async def test(peer: Peer, line: Exchanger) -> None:
        steps = line._exactly(1, 0.1)
        next(steps)
        loop = asyncio.get_running_loop()
        assert isinstance(loop, VirtualLoop)
        loop.jump(stood)
        with pytest.raises(_HeldUpError if held_up else StopIteration):
            steps.send(O)

    with_peer()(test)


def test_a_byte_instead_of_an_answer_is_kept_as_strange():
    async def test(peer: Peer, line: Exchanger) -> None:
        with pytest.raises(DeviceTimeoutError):
            await line.read(od.STATUSWORD)
        assert line.strange == b"\x07"

    with_peer(O, O + b"\x07")(test)


def test_a_repeat_that_breaks_off_is_waited_for_no_longer_than_one_that_does_not_begin():
    async def test(peer: Peer, line: Exchanger) -> None:
        assert await line.read(od.STATUSWORD) == DISABLED
        refused, asked_again = [at for at, data in peer.written if data in (F, b"\x10")][1:]
        assert asked_again - refused == pytest.approx(0.03, abs=1e-6)

    damaged = ANSWER[:-1] + bytes((ANSWER[-1] ^ 1,))
    with_peer(O, O + b"\0", damaged, ANSWER[:1], O, O + b"\0", ANSWER, b"")(test)


@pytest.mark.parametrize(("begins", "ends", "taken"), [(0.015, 0.025, True), (0.015, 0.035, False)])
def test_a_repeat_has_its_time_from_the_refusal_on(begins: float, ends: float, taken: bool):
    async def test(peer: Peer, line: Exchanger) -> None:
        def repeat() -> None:
            loop = asyncio.get_running_loop()
            loop.call_later(begins, peer.link.feed, ANSWER[:1])
            loop.call_later(ends, peer.link.feed, ANSWER[1:])

        peer.on_refusal = repeat
        reading = asyncio.ensure_future(line.read(od.STATUSWORD))
        await asyncio.wait([reading], timeout=0.04)
        asked = [data for _, data in peer.written].count(b"\x10")
        assert asked == (1 if taken else 2)
        if taken:
            assert reading.result() == DISABLED
        reading.cancel()

    damaged = ANSWER[:-1] + bytes((ANSWER[-1] ^ 1,))
    with_peer(O, O + b"\0", damaged)(test)


@pytest.mark.parametrize(("early", "held_up"), [(0, True), (1, False)])
def test_a_process_stood_still_if_a_wait_took_as_long_as_a_half_frame_is_kept(early: int, held_up: bool):
    async def test(peer: Peer, line: Exchanger) -> None:
        asked = line._clock.now() - round(QUIET * SECOND) + early
        if held_up:
            with pytest.raises(_HeldUpError, match=r"suspended for 0\.6 s"):
                line._check_held_up(asked)
        else:
            line._check_held_up(asked)

    with_peer()(test)


def test_a_refused_read_names_the_object_and_a_refused_write_its_value():
    async def test(emulator: EposEmulator, line: Exchanger, clock: VirtualClock) -> None:
        with pytest.raises(ObjectError) as read:
            await line.read(od.ObjectEntry("nothing", 0x7FFF, 0, 16))
        assert "(nothing): 0x" in str(read.value)
        with pytest.raises(ObjectError) as written:
            await line.write(od.MODE, 99)
        assert "(mode of operation) = 99: 0x" in str(written.value)

    on_line(test)


@pytest.mark.parametrize("reply", range(3))
def test_after_a_standstill_of_this_process_a_new_exchange_begins_at_once(reply: int):
    async def test(peer: Peer, line: Exchanger) -> None:
        peer.stand_still_before = reply
        with pytest.raises(DeviceTimeoutError, match=r"suspended for 1\.5 s"):
            await line.read(od.STATUSWORD)
        peer.replies = [O, O + b"\0", ANSWER]
        begun = len(peer.written)
        assert await line.read(od.STATUSWORD) == DISABLED
        assert peer.written[begun][0] == pytest.approx(1.5, abs=0.001)

    with_peer(O, O + b"\0", ANSWER)(test)


def test_late_bytes_prolong_the_silence_and_are_never_taken_for_an_answer():
    async def test(emulator: EposEmulator, line: Exchanger, clock: VirtualClock) -> None:
        emulator.inject("delay", "600", "1")
        with pytest.raises(DeviceTimeoutError):
            await line.read(od.POSITION)
        assert 0.85 < await time_of(clock, line.settle()) < 1.0
        assert await line.read(od.STATUSWORD) == DISABLED

    on_line(test)


def test_retries_are_counted():
    async def test(emulator: EposEmulator, line: Exchanger, clock: VirtualClock) -> None:
        emulator.inject("delay", "600", "1")
        assert await line.read(od.STATUSWORD, attempts=2) == DISABLED
        emulator.inject("silent", "on")
        with pytest.raises(DeviceTimeoutError):
            await line.read(od.STATUSWORD, attempts=2)
        with pytest.raises(ValueError, match="at least one"):
            await line.read(od.STATUSWORD, attempts=0)

    on_line(test)


def test_a_line_that_never_falls_silent_does_not_hang():
    async def main(clock: VirtualClock) -> None:
        link = Link("chatter", lambda _: None, lambda: None)

        async def chatter() -> None:
            while True:
                link.feed(b"$C320.5P0.2R-18.3T19.0*3C\r\n")
                await clock.sleep(0.05)

        task = asyncio.create_task(chatter())
        line = Exchanger(link, clock, 1)
        start = clock.now()
        with pytest.raises(ProtocolError):
            await line.read(od.STATUSWORD, attempts=2)
        assert (clock.now() - start) / SECOND < 1.5
        assert line.strange
        assert not line.acknowledged
        task.cancel()

    run_virtual(main)


def test_a_cancelled_exchange_is_finished_before_the_next():
    async def test(emulator: EposEmulator, line: Exchanger, clock: VirtualClock) -> None:
        emulator.inject("delay", "50", "1")
        task = asyncio.create_task(line.write(od.TARGET_VELOCITY, 5))
        await clock.sleep(0.02)
        task.cancel()
        with pytest.raises(asyncio.CancelledError):
            await task
        assert await line.read(od.STATUSWORD) == DISABLED
        assert len(emulator.frames) == 2
        assert line.quiet_until == 0

    on_line(test)


def test_a_lost_link_ends_the_exchange_and_leaves_word_when_to_go_on():
    async def test(peer: Peer, line: Exchanger) -> None:
        asyncio.get_running_loop().call_later(0.05, peer.link.lose, "unplugged")
        with pytest.raises(DeviceLostError):
            await line.read(od.STATUSWORD)
        assert line.quiet_until == pytest.approx((1.05 + 0.55) * SECOND, abs=0.001 * SECOND)

    with_peer(O)(test)


def test_an_exchange_waits_for_the_silence_left_by_an_earlier_link():
    async def test(emulator: EposEmulator, line: Exchanger, clock: VirtualClock) -> None:
        line.quiet_until = clock.now() + SECOND // 4
        assert await time_of(clock, line.read(od.STATUSWORD)) == pytest.approx(0.253, abs=0.002)

    on_line(test)


def test_long_objects_come_in_segments():
    async def test(emulator: EposEmulator, line: Exchanger, clock: VirtualClock) -> None:
        assert (await line.read_long(od.SERIAL_NUMBER)).hex() == "6301602400001234"
        assert await line.read_long(od.SOFTWARE_VERSION) == b"\x24\x20"

    on_line(test)


def segment_replies(*segments: tuple[int, ...]) -> list[bytes]:
    replies = [O, O + b"\0", answer().body, b""]
    for words in segments:
        replies += [O, O + b"\0", answer(0, *words).body, b""]
    return replies


def test_endless_or_short_segments_are_errors():
    async def endless(peer: Peer, line: Exchanger) -> None:
        with pytest.raises(ProtocolError, match="more than 16 segments"):
            await line.read_long(od.SERIAL_NUMBER)

    async def short(peer: Peer, line: Exchanger) -> None:
        with pytest.raises(ProtocolError, match="shorter"):
            await line.read_long(od.SERIAL_NUMBER)

    with_peer(*segment_replies(*[ObjectSegment(b"ab", False, True).words] * 16))(endless)
    with_peer(*segment_replies((0x0005,)))(short)


def test_a_wrong_toggle_bit_is_refused():
    async def test(emulator: EposEmulator, line: Exchanger, clock: VirtualClock) -> None:
        await line.read_long(od.SERIAL_NUMBER)
        await line.read_long(od.SOFTWARE_VERSION)
        emulator._long = (b"abc", True)
        with pytest.raises(ObjectError, match="toggle"):
            await line._answer(segment_request(False), "segment", 1)

    on_line(test)
