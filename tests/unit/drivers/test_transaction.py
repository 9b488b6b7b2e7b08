import asyncio

import pytest

from monstertruck_drivers.link import Link
from monstertruck_drivers.transaction import Transaction, WaitFor
from monstertruck_runtime.clock import SECOND, run_virtual
from monstertruck_runtime.errors import DeviceLostError


def on_link(scenario):
    async def main(clock):
        written = []
        return await scenario(Link("port", written.append, lambda: None), written, clock)

    return run_virtual(main)


def greet(link):
    name = yield WaitFor(3, 1.0)
    link.write(b"hello " + name)
    rest = yield WaitFor(2, 1.0)
    return name + rest


def test_it_answers_within_the_callback_that_brings_the_bytes():
    async def scenario(link, written, _):
        transaction = Transaction(link, greet(link))
        link.feed(b"an")
        assert written == []
        link.feed(b"nab")
        assert written == [b"hello ann"]
        link.feed(b"cd")
        assert transaction.ended
        assert await transaction.result() == b"annab"
        assert await link.read() == b"cd"

    on_link(scenario)


def test_bytes_that_are_here_already_are_not_waited_for():
    async def scenario(link, _, __):
        link.feed(b"annbc")
        transaction = Transaction(link, greet(link))
        assert transaction.ended
        assert await transaction.result() == b"annbc"

    on_link(scenario)


def test_it_goes_on_when_nobody_waits_any_more():
    async def scenario(link, written, _):
        transaction = Transaction(link, greet(link))
        waiting = asyncio.create_task(transaction.result())
        await asyncio.sleep(0)
        waiting.cancel()
        await asyncio.wait([waiting])
        link.feed(b"annbc")
        await transaction.end()
        assert written == [b"hello ann"]

    on_link(scenario)


def test_a_wait_may_be_too_long():
    def repeated():
        try:
            yield WaitFor(1, 0.5)
        except TimeoutError:
            return "late"

    async def scenario(link, _, clock):
        begin = clock.now()
        assert await Transaction(link, repeated()).result() == "late"
        assert (clock.now() - begin) / SECOND == pytest.approx(0.5, abs=0.01)

    on_link(scenario)


def test_a_pause_ends_by_time_not_by_bytes():
    def pausing():
        yield WaitFor(0, 0.5)

    async def scenario(link, _, clock):
        begin = clock.now()
        transaction = Transaction(link, pausing())
        link.feed(b"x")
        assert not transaction.ended
        await transaction.end()
        assert (clock.now() - begin) / SECOND == pytest.approx(0.5, abs=0.01)
        assert link.discard() == 1

    on_link(scenario)


@pytest.mark.parametrize("count", [1, 0], ids=["bytes", "pause"])
def test_a_lost_link_ends_every_wait(count):
    def steps(link):
        yield WaitFor(count, 9.0)
        link.write(b"?")

    async def scenario(link, _, clock):
        transaction = Transaction(link, steps(link))
        link.lose("unplugged")
        assert transaction.ended
        with pytest.raises(DeviceLostError, match="unplugged"):
            await transaction.result()
        with pytest.raises(DeviceLostError):
            await Transaction(link, steps(link)).result()

    on_link(scenario)


def test_broken_off_it_gives_the_link_back():
    ended = []

    def steps():
        try:
            yield WaitFor(1, 1.0)
        finally:
            ended.append(True)

    async def scenario(link, _, __):
        transaction = Transaction(link, steps())
        transaction.cancel()
        assert ended == [True]
        await transaction.end()
        link.feed(b"x")
        assert await link.exactly(1, 0.1) == b"x"

    on_link(scenario)


def test_two_readers_are_refused():
    async def scenario(link, _, __):
        transaction = Transaction(link, greet(link))
        with pytest.raises(RuntimeError, match="a second reader"):
            await link.read()
        transaction.cancel()

    on_link(scenario)


class TimeOutOfTestError(BaseException):
    """What a test's alarm raises, wherever the program is."""


@pytest.mark.parametrize("come", [b"x", None], ids=["by bytes", "by time"])
def test_an_error_outside_exception_ends_it_too(come):
    def steps():
        try:
            yield WaitFor(1, 0.5)
        finally:
            raise TimeOutOfTestError

    transactions = []

    async def scenario(link, _, clock):
        transaction = Transaction(link, steps())
        transactions.append(transaction)
        waiting = asyncio.create_task(transaction.end())
        await asyncio.sleep(0)
        if come is not None:
            with pytest.raises(TimeOutOfTestError):
                link.feed(come)
            await waiting
            link.feed(b"y")
            assert await link.exactly(1, 0.1) == b"y", "the link is free"
            with pytest.raises(TimeOutOfTestError):
                await transaction.result()
        await clock.sleep(1.0)

    if come is not None:
        on_link(scenario)
    else:
        with pytest.raises(TimeOutOfTestError):
            on_link(scenario)
    assert transactions[0].ended


def test_an_alarm_between_bytes_and_steps_ends_it(monkeypatch):
    async def scenario(link, _, __):
        transaction = Transaction(link, greet(link))

        def alarm(_):
            raise TimeOutOfTestError

        monkeypatch.setattr(link, "take", alarm)
        with pytest.raises(TimeOutOfTestError):
            link.feed(b"ann")
        assert transaction.ended

    on_link(scenario)


def test_it_ends_though_its_steps_cannot_be_closed():
    def steps():
        while True:
            try:
                yield WaitFor(1, 1.0)
            except GeneratorExit:
                yield WaitFor(1, 1.0)

    async def scenario(link, _, __):
        transaction = Transaction(link, steps())
        with pytest.raises(RuntimeError, match="ignored GeneratorExit"):
            transaction.cancel()
        await transaction.end()

    on_link(scenario)
