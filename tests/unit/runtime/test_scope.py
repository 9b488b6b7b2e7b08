"""Scopes end inside-out, whatever ends them."""

import asyncio

import pytest

from monstertruck_runtime.clock import VirtualClock, run_virtual
from monstertruck_runtime.service import scope


async def until_cancelled(name: str, log: list[str], linger: float = 0.0) -> None:
    try:
        await asyncio.Event().wait()
    finally:
        await asyncio.sleep(linger)
        log.append(name)


def test_inner_scopes_and_newer_services_end_first_and_completely():
    log: list[str] = []

    async def main(_: VirtualClock) -> None:
        async with scope("outer") as outer:
            outer.start("bus", until_cancelled("bus", log))
            outer.start("recorder", until_cancelled("recorder", log))
            async with scope("inner") as inner:
                inner.start("gate", until_cancelled("gate", log, linger=2.0))
                inner.start("planner", until_cancelled("planner", log, linger=5.0))
                await asyncio.sleep(1)

    run_virtual(main)
    assert log == ["planner", "gate", "recorder", "bus"]


def test_a_bug_in_an_outer_service_still_ends_inner_ones_first():
    log: list[str] = []

    async def bug() -> None:
        await asyncio.sleep(1)
        raise ZeroDivisionError

    async def main(_: VirtualClock) -> None:
        async with scope("outer") as outer:
            outer.start("bus", until_cancelled("bus", log))
            outer.start("gate", bug())
            async with scope("inner") as inner:
                inner.start("planner", until_cancelled("planner", log, linger=1.0))
                await asyncio.Event().wait()

    with pytest.raises(ExceptionGroup) as caught:
        run_virtual(main)
    assert caught.group_contains(ZeroDivisionError)
    assert log == ["planner", "bus"]


def test_cancelling_the_owner_ends_everything_in_order():
    log: list[str] = []

    async def daemon() -> None:
        async with scope("outer") as outer:
            outer.start("bus", until_cancelled("bus", log))
            async with scope("inner") as inner:
                inner.start("gate", until_cancelled("gate", log, linger=0.5))
                await asyncio.Event().wait()

    async def main(_: VirtualClock) -> None:
        task = asyncio.create_task(daemon())
        await asyncio.sleep(1)
        task.cancel()
        with pytest.raises(asyncio.CancelledError):
            await task

    run_virtual(main)
    assert log == ["gate", "bus"]


def test_a_second_failure_while_ending_leaves_nothing_running():
    log: list[str] = []

    async def fail_after(seconds: float) -> None:
        await asyncio.sleep(seconds)
        raise ZeroDivisionError

    async def daemon() -> None:
        async with scope("actuators") as actuators:
            actuators.start("drive", until_cancelled("drive", log))
            async with scope("gate") as gate:
                gate.start("gate", fail_after(1.5))
                async with scope("planners") as planners:
                    planners.start("map", until_cancelled("map", log, linger=2.0))
                    planners.start("tracker", fail_after(1.0))
                    await asyncio.Event().wait()

    async def main(_: VirtualClock) -> int:
        with pytest.raises(BaseExceptionGroup):
            await daemon()
        task = asyncio.current_task()
        assert task is not None
        assert task.cancelling() == 0
        return len(asyncio.all_tasks())

    assert run_virtual(main) == 1
    assert log == ["map", "drive"]


def test_a_cancellation_while_ending_reaches_the_owner():
    log: list[str] = []

    async def daemon() -> None:
        async with scope("outer") as outer:
            outer.start("bus", until_cancelled("bus", log))
            async with scope("inner") as inner:
                inner.start("gate", until_cancelled("gate", log, linger=1.0))
                await asyncio.sleep(0.1)
            log.append("went on")
            await asyncio.Event().wait()

    async def main(_: VirtualClock) -> None:
        task = asyncio.create_task(daemon())
        await asyncio.sleep(0.5)
        task.cancel()
        with pytest.raises(asyncio.CancelledError):
            await task

    run_virtual(main)
    assert log == ["gate", "bus"]
