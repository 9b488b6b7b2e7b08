"""Questions and answers of the Maestro, which carry no mark of their own: late, strange and missing answers."""

import asyncio
from collections.abc import Callable, Coroutine
from typing import Any

import pytest

from monstertruck_drivers.link import Link
from monstertruck_drivers.maestro.protocol import ERROR_MASK, POSITION_MAX, Encoder
from monstertruck_drivers.maestro.session import MaestroSession
from monstertruck_runtime.clock import SECOND, VirtualClock, run_virtual
from monstertruck_runtime.errors import DeviceLostError, DeviceTimeoutError, ProtocolError, WrongDeviceError

RESYNC_TRIES = 4
QUIET_AFTER_ANSWER = 0.02
IDENTIFY_ATTEMPTS = 3

TIMEOUT = 0.1
CENTRE = 6000
ENCODE = Encoder()
POSITION, ERRORS = ENCODE.get_position(0), ENCODE.get_errors()


def words(*values: int) -> bytes:
    return b"".join(value.to_bytes(2, "little") for value in values)


class Peer:
    """Meets each write of the host with the next reply; None = with none."""

    def __init__(self, clock: VirtualClock) -> None:
        self.written: list[bytes] = []
        self.replies: list[bytes | None] = []
        self.link = Link("servos", self._take, lambda: None)
        self.session = MaestroSession(self.link, clock, ENCODE, TIMEOUT)

    def _take(self, data: bytes) -> None:
        self.written.append(data)
        if self.replies and (reply := self.replies.pop(0)) is not None:
            self.link.feed(reply)


def with_peer(*replies: bytes | None) -> Callable[[Callable[[Peer, VirtualClock], Coroutine[Any, Any, None]]], None]:
    """Run ``test(peer, clock)`` against scripted replies."""

    def run(test: Callable[[Peer, VirtualClock], Coroutine[Any, Any, None]]) -> None:
        async def main(clock: VirtualClock) -> None:
            peer = Peer(clock)
            peer.replies = list(replies)
            await test(peer, clock)

        run_virtual(main)

    return run


def test_each_question_has_a_word():
    async def test(peer: Peer, _: VirtualClock) -> None:
        assert await peer.session.ask(POSITION, ERRORS) == [CENTRE, 3]
        assert peer.written == [POSITION + ERRORS], "in one go"

    with_peer(words(CENTRE, 3))(test)


def test_commands_go_out_in_one_go_without_a_wait():
    async def test(peer: Peer, _: VirtualClock) -> None:
        peer.session.send(b"ab", b"c")
        assert peer.written == [b"abc"]

    with_peer()(test)


@pytest.mark.parametrize("late", [b"", words(CENTRE), words(CENTRE) + b"\0"])
def test_after_a_missing_answer_the_next_one_is_asked_for_once_the_late_one_is_waited_out(late: bytes):
    async def test(peer: Peer, clock: VirtualClock) -> None:
        began = clock.now()
        with pytest.raises(DeviceTimeoutError, match=r"servos: no answer within 0\.1 s"):
            await peer.session.ask(ERRORS)
        assert (clock.now() - began) / SECOND == pytest.approx(TIMEOUT, abs=1e-6)
        if late:
            peer.link.feed(late)
        peer.replies = [words(CENTRE), words(5)]
        assert await peer.session.ask(ERRORS) == [5]
        assert peer.written == [ERRORS, POSITION, ERRORS]
        peer.replies = [words(6)]
        assert await peer.session.ask(ERRORS) == [6]
        assert peer.written[3:] == [ERRORS], "in step again"

    with_peer(None)(test)


def test_nothing_is_asked_while_a_late_answer_is_still_coming():
    async def test(peer: Peer, clock: VirtualClock) -> None:
        with pytest.raises(DeviceTimeoutError):
            await peer.session.ask(ERRORS)
        peer.link.feed(b"\1")
        asyncio.get_running_loop().call_later(0.9 * QUIET_AFTER_ANSWER, peer.link.feed, b"\2")
        peer.replies = [words(CENTRE), words(5)]
        began = clock.now()
        assert await peer.session.ask(ERRORS) == [5]
        assert peer.written == [ERRORS, POSITION, ERRORS]
        assert (clock.now() - began) / SECOND == pytest.approx(2.9 * QUIET_AFTER_ANSWER, abs=1e-3)

    with_peer(None)(test)


def test_a_byte_too_many_is_waited_out_as_well():
    async def test(peer: Peer, _: VirtualClock) -> None:
        assert await peer.session.ask(ERRORS) == [1]
        peer.replies = [words(CENTRE), words(2)]
        assert await peer.session.ask(ERRORS) == [2]
        assert peer.written == [ERRORS, POSITION, ERRORS]

    with_peer(words(1) + b"\0")(test)


def test_silence_while_it_comes_into_step_is_a_timeout_and_tried_again_at_the_next_question():
    async def test(peer: Peer, _: VirtualClock) -> None:
        for count in (1, 2, 3):
            with pytest.raises(DeviceTimeoutError, match="no answer within"):
                await peer.session.ask(ERRORS)
            assert peer.written == [ERRORS, POSITION, POSITION][:count]

    with_peer()(test)


def test_a_strange_byte_is_not_forgotten_while_nothing_answers():
    async def test(peer: Peer, _: VirtualClock) -> None:
        peer.link.feed(b"\0")
        for count in (1, 2):
            with pytest.raises(DeviceTimeoutError):
                await peer.session.ask(ERRORS)
            assert peer.written == [POSITION] * count

    with_peer()(test)


def test_answers_that_stay_too_long_are_given_up():
    async def test(peer: Peer, _: VirtualClock) -> None:
        with pytest.raises(DeviceTimeoutError):
            await peer.session.ask(ERRORS)
        peer.replies = [words(CENTRE) + b"\0"] * 9
        with pytest.raises(DeviceTimeoutError, match="answers remain out of step"):
            await peer.session.ask(ERRORS)
        assert peer.written == [ERRORS, *[POSITION] * RESYNC_TRIES]
        assert RESYNC_TRIES == 4

    with_peer(None)(test)


def test_identify_reads_the_positions_and_returns_the_errors():
    async def test(peer: Peer, _: VirtualClock) -> None:
        assert await peer.session.identify(0, 1) == 0x0010
        assert peer.written == [POSITION + ENCODE.get_position(1) + ERRORS]

    with_peer(words(CENTRE, CENTRE, 0x0010))(test)


@pytest.mark.parametrize(
    "answer",
    [words(CENTRE, ERROR_MASK + 1), words(POSITION_MAX + 1, 0), words(CENTRE, 0) + b"\0"],
    ids=["errors", "position", "a byte too many"],
)
def test_a_device_that_answers_out_of_form_is_no_maestro(answer: bytes):
    async def test(peer: Peer, _: VirtualClock) -> None:
        peer.replies = [answer if reply is None else reply for reply in peer.replies]
        with pytest.raises(WrongDeviceError, match="not a Maestro"):
            await peer.session.identify(0)
        assert peer.written.count(POSITION + ERRORS) == IDENTIFY_ATTEMPTS == 3

    with_peer(None, None, None)(test)


def test_one_answer_out_of_form_is_asked_for_again():
    async def test(peer: Peer, _: VirtualClock) -> None:
        assert await peer.session.identify(0) == 2

    with_peer(words(CENTRE, ERROR_MASK + 1), words(CENTRE, 2))(test)


def test_silence_names_what_to_set():
    async def test(peer: Peer, _: VirtualClock) -> None:
        with pytest.raises(DeviceTimeoutError, match="silent; expected a Maestro's Command Port"):
            await peer.session.identify(0)

    with_peer()(test)


def test_one_that_speaks_unasked_and_does_not_answer_is_no_maestro():
    async def test(peer: Peer, _: VirtualClock) -> None:
        peer.link.feed(b"hello")
        with pytest.raises(WrongDeviceError):
            await peer.session.identify(0)

    with_peer()(test)


@pytest.mark.parametrize(
    ("positions", "errors", "fine"),
    [
        ([CENTRE, POSITION_MAX], ERROR_MASK, True),
        ([CENTRE, POSITION_MAX + 1], 0, False),
        ([POSITION_MAX + 1, CENTRE], 0, False),
        ([CENTRE], ERROR_MASK + 1, False),
    ],
)
def test_words_that_cannot_be_an_answer_are_refused(positions: list[int], errors: int, fine: bool):
    async def test(peer: Peer, _: VirtualClock) -> None:
        if fine:
            peer.session.check(positions, errors)
        else:
            with pytest.raises(ProtocolError, match=f"errors {errors:#x}"):
                peer.session.check(positions, errors)

    with_peer()(test)


def test_an_unplugged_device_is_noticed_without_a_word():
    async def test(peer: Peer, _: VirtualClock) -> None:
        peer.session.require_link()
        peer.link.close()
        with pytest.raises(DeviceLostError, match="servos: unplugged"):
            peer.session.require_link()
        assert peer.written == []

    with_peer()(test)
