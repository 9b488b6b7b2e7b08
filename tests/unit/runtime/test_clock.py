"""The virtual loop jumps; deadlines, ordering and determinism hold on it."""

import asyncio
import signal
import socket
import weakref

import pytest

from monstertruck_runtime import clock as clocks
from monstertruck_runtime.clock import (
    SECOND,
    HungError,
    ReplayClock,
    VirtualClock,
    WallClock,
    run_replay,
    run_virtual,
    run_wall,
)


def test_an_hour_of_sleep_takes_no_time_and_wakes_on_time():
    async def main(clock: VirtualClock) -> int:
        start = clock.now()
        await clock.sleep(3600)
        return clock.now() - start

    slept = run_virtual(main)
    assert 3600 * SECOND <= slept < 3600 * SECOND + 1000


def test_interleaving_is_identical_in_two_runs():
    async def main(clock: VirtualClock) -> list[tuple[str, int]]:
        log: list[tuple[str, int]] = []

        async def beat(name: str, period: int) -> None:
            due = clock.now()
            for _ in range(50):
                due += period
                await clock.sleep_until(due)
                log.append((name, clock.now()))

        await asyncio.gather(beat("a", 20_000_000), beat("b", 30_000_000), beat("c", 7_000_000))
        return log

    assert run_virtual(main) == run_virtual(main)


def test_deadline_raises_inside():
    async def main(clock: VirtualClock) -> int:
        start = clock.now()
        with pytest.raises(TimeoutError):
            async with clock.deadline(1.5):
                await clock.sleep(10)
        return clock.now() - start

    assert run_virtual(main) == pytest.approx(1.5 * SECOND, abs=10)


def test_sleep_until_the_past_returns_at_once():
    async def main(clock: VirtualClock) -> int:
        await clock.sleep_until(clock.now() - 5)
        return clock.now()

    assert run_virtual(main, start=77) == 77


async def test_a_late_task_lets_others_run_on_the_wall_clock():
    clock, ran = WallClock(), []
    asyncio.get_running_loop().call_soon(ran.append, True)
    await clock.sleep_until(clock.now() - SECOND)
    assert ran


def test_replay_clock_starts_at_the_log_and_keeps_its_real_time():
    async def main(clock: ReplayClock) -> tuple[int, int]:
        return clock.now(), clock.real_offset()

    assert run_replay(main, start=123, real_offset=5, rate=None) == (123, 5)


async def test_wall_clock_is_monotonic_and_knows_real_time():
    clock = WallClock()
    before = clock.now()
    await clock.sleep(0.01)
    assert clock.now() - before >= 9_000_000
    assert clock.now() + clock.real_offset() > 1_700_000_000 * SECOND


def test_timers_of_one_instant_fire_in_the_order_they_were_set():
    async def main(clock: VirtualClock) -> list[int]:
        fired: list[int] = []
        loop = asyncio.get_running_loop()
        due = loop.time() + 1
        for number in range(50):
            loop.call_at(due, fired.append, number)
        await clock.sleep(2)
        return fired

    assert run_virtual(main) == list(range(50))


def test_another_thread_reaches_the_loop_with_and_without_timers():
    async def main(clock: VirtualClock) -> tuple[str, str]:
        ticking = asyncio.create_task(clock.sleep(1e9))
        with_timers = await asyncio.to_thread(lambda: "a")
        ticking.cancel()
        return with_timers, await asyncio.to_thread(lambda: "b")

    assert run_virtual(main) == ("a", "b")


def test_a_timer_cancelled_at_its_own_instant_does_not_fire():
    async def main(clock: VirtualClock) -> list[str]:
        fired: list[str] = []
        loop = asyncio.get_running_loop()
        due = loop.time() + 1
        loop.call_at(due, lambda: second.cancel())
        second = loop.call_at(due, fired.append, "second")
        loop.call_at(due, fired.append, "third")
        await clock.sleep(2)
        return fired

    assert run_virtual(main) == ["third"]


def test_time_does_not_stop_at_cancelled_timers_and_they_are_let_go():
    class Held:
        pass

    async def main(clock: VirtualClock) -> tuple[int, int]:
        start = clock.now()
        loop = asyncio.get_running_loop()
        held: weakref.WeakSet[Held] = weakref.WeakSet()
        for _ in range(1000):
            thing = Held()
            held.add(thing)
            loop.call_later(1800, lambda thing: None, thing).cancel()
        kept = len(held)
        await clock.sleep(3600)
        return clock.now() - start, kept

    slept, kept = run_virtual(main)
    assert 3600 * SECOND <= slept <= 3600 * SECOND + 1
    assert kept < 200


def test_watched_files_are_heard_while_timers_run():
    async def main(clock: VirtualClock) -> bytes:
        near, far = socket.socketpair()
        with near, far:
            near.setblocking(False)
            ticking = asyncio.create_task(clock.sleep(1e6))
            received = asyncio.create_task(asyncio.get_running_loop().sock_recv(near, 5))
            await clock.sleep(1)
            far.send(b"hello")
            data = await received
            ticking.cancel()
            return data

    assert run_virtual(main) == b"hello"


@pytest.mark.parametrize(("interrupts", "ended"), [(1, True), (2, True), (3, False)])
def test_a_second_interrupt_does_not_disturb_the_end_of_the_first_and_a_third_breaks_it_off(interrupts, ended):
    ends = []

    async def main(clock):
        for _ in range(interrupts):
            asyncio.get_running_loop().call_soon(signal.raise_signal, signal.SIGINT)
        try:
            await clock.sleep(10.0)
        finally:
            await clock.sleep(0.05)
            ends.append(clock.now())

    before = signal.getsignal(signal.SIGINT)
    with pytest.raises(KeyboardInterrupt):
        run_wall(main)
    assert bool(ends) is ended
    assert signal.getsignal(signal.SIGINT) is before


# A hang is a failure, with a dump


class TimeOutOfTestError(BaseException):
    """What a test's alarm raises, wherever the program is."""


def alarm() -> None:
    raise TimeOutOfTestError


def test_a_time_out_inside_a_callback_ends_the_run():
    """asyncio reports it to the exception handler and goes on: one run went on for 52 000 virtual seconds."""
    ticks = 0

    async def main(clock: VirtualClock) -> None:
        nonlocal ticks
        asyncio.get_running_loop().call_later(1.0, alarm)
        while True:
            await clock.sleep(0.5)
            ticks += 1

    with pytest.raises(TimeOutOfTestError):
        run_virtual(main)
    assert ticks <= 2


def test_time_that_stands_is_a_failure_that_names_the_task(capsys: pytest.CaptureFixture[str]):
    async def spin() -> None:
        while True:
            await asyncio.sleep(0)

    async def main(clock: VirtualClock) -> None:
        spinning = asyncio.create_task(spin(), name="spinning")
        await clock.sleep(1.0)
        await spinning

    with pytest.raises(HungError, match=r"has taken .* of processor time; 2 tasks"):
        run_virtual(main, guard=0.3)
    assert "await asyncio.sleep(0)" in capsys.readouterr().err


def test_waiting_for_a_thread_that_never_answers_is_a_failure(capsys: pytest.CaptureFixture[str]):
    async def main(_: VirtualClock) -> None:
        await asyncio.get_running_loop().create_future()

    with pytest.raises(HungError, match=r"waited for .* without a timer"):
        run_virtual(main, guard=0.2)
    assert "create_future" in capsys.readouterr().err


def test_tasks_that_do_not_end_are_a_failure(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]):
    monkeypatch.setattr(clocks, "ENDING", 10.0)
    seen = []

    async def stubborn(clock: VirtualClock) -> None:
        while True:
            try:
                await clock.sleep(0.5)
            except asyncio.CancelledError:
                seen.append(clock.now())

    async def main(clock: VirtualClock) -> None:
        seen.append(asyncio.create_task(stubborn(clock)))
        await clock.sleep(1.0)

    with pytest.raises(HungError, match="not ended within 10 virtual seconds"):
        run_virtual(main)
    assert "stubborn" in capsys.readouterr().err
    seen.clear()


def test_a_long_run_of_many_virtual_seconds_is_no_hang():
    async def main(clock: VirtualClock) -> None:
        for _ in range(20_000):
            await clock.sleep(0.3)

    run_virtual(main, guard=0.2)
