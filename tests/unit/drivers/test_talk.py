import asyncio

import pytest

from monstertruck_drivers.link import Link
from monstertruck_drivers.talk import Need, Talk
from monstertruck_runtime.clock import SECOND, run_virtual
from monstertruck_runtime.errors import DeviceLostError


def on_link(scenario):
    async def main(clock):
        written = []
        return await scenario(Link("port", written.append, lambda: None), written, clock)

    return run_virtual(main)


def greet(link):
    name = yield Need(3, 1.0)
    link.write(b"hello " + name)
    rest = yield Need(2, 1.0)
    return name + rest


def test_it_answers_within_the_callback_that_brings_the_bytes():
    async def scenario(link, written, _):
        talk = Talk(link, greet(link))
        link.feed(b"an")
        assert written == []
        link.feed(b"nab")
        assert written == [b"hello ann"]
        link.feed(b"cd")
        assert talk.ended
        assert await talk.result() == b"annab"
        assert await link.read() == b"cd"

    on_link(scenario)


def test_bytes_that_are_here_already_are_not_waited_for():
    async def scenario(link, _, __):
        link.feed(b"annbc")
        talk = Talk(link, greet(link))
        assert talk.ended
        assert await talk.result() == b"annbc"

    on_link(scenario)


def test_it_goes_on_when_nobody_waits_any_more():
    async def scenario(link, written, _):
        talk = Talk(link, greet(link))
        waiting = asyncio.create_task(talk.result())
        await asyncio.sleep(0)
        waiting.cancel()
        await asyncio.wait([waiting])
        link.feed(b"annbc")
        await talk.end()
        assert written == [b"hello ann"]

    on_link(scenario)


def test_a_wait_may_be_too_long():
    def repeated():
        try:
            yield Need(1, 0.5)
        except TimeoutError:
            return "late"

    async def scenario(link, _, clock):
        begin = clock.now()
        assert await Talk(link, repeated()).result() == "late"
        assert (clock.now() - begin) / SECOND == pytest.approx(0.5, abs=0.01)

    on_link(scenario)


def test_a_pause_ends_by_time_not_by_bytes():
    def pausing():
        yield Need(0, 0.5)

    async def scenario(link, _, clock):
        begin = clock.now()
        talk = Talk(link, pausing())
        link.feed(b"x")
        assert not talk.ended
        await talk.end()
        assert (clock.now() - begin) / SECOND == pytest.approx(0.5, abs=0.01)
        assert link.discard() == 1

    on_link(scenario)


@pytest.mark.parametrize("count", [1, 0], ids=["bytes", "pause"])
def test_a_lost_link_ends_every_wait(count):
    def steps(link):
        yield Need(count, 9.0)
        link.write(b"?")

    async def scenario(link, _, clock):
        talk = Talk(link, steps(link))
        link.lose("unplugged")
        assert talk.ended
        with pytest.raises(DeviceLostError, match="unplugged"):
            await talk.result()
        with pytest.raises(DeviceLostError):
            await Talk(link, steps(link)).result()

    on_link(scenario)


def test_broken_off_it_gives_the_link_back():
    ended = []

    def steps():
        try:
            yield Need(1, 1.0)
        finally:
            ended.append(True)

    async def scenario(link, _, __):
        talk = Talk(link, steps())
        talk.cancel()
        assert ended == [True]
        await talk.end()
        link.feed(b"x")
        assert await link.exactly(1, 0.1) == b"x"

    on_link(scenario)


def test_two_readers_are_refused():
    async def scenario(link, _, __):
        talk = Talk(link, greet(link))
        with pytest.raises(RuntimeError, match="two readers"):
            await link.read()
        talk.cancel()

    on_link(scenario)
