"""A slower computer on the virtual clock: what is computed takes its time, and nothing does without a factor."""

import asyncio

import pytest

from monstertruck_runtime.actors.actor import LoopActor
from monstertruck_runtime.clock import SECOND, VirtualClock, processor_time, run_virtual
from monstertruck_runtime.slowness import BOARDS, SlowComputer, factor_of, slow_computer


def compute(seconds: float) -> None:
    until = processor_time() + seconds
    while processor_time() < until:
        pass


class Quick:
    def step(self, inputs: object) -> object:
        return inputs


def test_what_a_service_and_its_tasks_compute_moves_the_time_on_by_the_factor():
    async def main(clock: VirtualClock) -> tuple[float, float, dict[str, list[float]]]:
        async def child() -> None:
            compute(0.002)

        async def work() -> str:
            async with asyncio.TaskGroup() as group:
                compute(0.002)
                group.create_task(child())
            await clock.sleep(0.0)
            return "done"

        computer = SlowComputer(clock, 100.0)
        begin = clock.now()
        task = asyncio.create_task(computer.service("tracker", work()))
        late = asyncio.create_task(clock.sleep(0.01))
        await late
        came = (clock.now() - begin) / SECOND
        assert await task == "done"
        compute(0.002)  # of nobody: not charged
        return came, (clock.now() - begin) / SECOND, computer.turns

    came, took, turns = run_virtual(main)
    assert came >= 0.2, "a timer of others fires behind the computation"
    assert 0.4 <= took == pytest.approx(100 * sum(turns["tracker"]), rel=0.05)
    assert list(turns) == ["tracker"]


def test_a_cancelled_service_ends_as_on_any_computer():
    async def main(clock: VirtualClock) -> list[str]:
        seen = []

        async def work() -> None:
            try:
                await clock.sleep(5.0)
            except asyncio.CancelledError:
                seen.append("cancelled")
                raise

        task = asyncio.create_task(SlowComputer(clock, 2.0).service("gate", work()))
        await clock.sleep(0.1)
        task.cancel()
        with pytest.raises(asyncio.CancelledError):
            await task
        return seen

    assert run_virtual(main) == ["cancelled"]


def test_a_step_in_the_loop_is_delivered_after_its_declared_latency_times_the_factor():
    async def main(clock: VirtualClock, factor: float | None) -> float:
        if factor is not None:
            SlowComputer(clock, factor)
        begin = clock.now()
        async with LoopActor(f"{__name__}:Quick", clock, 0.05) as actor:
            assert await actor.step(3) == 3
        assert (slow_computer(clock) is None) == (factor is None)
        return (clock.now() - begin) / SECOND

    assert run_virtual(lambda clock: main(clock, None)) == pytest.approx(0.05, abs=1e-6)
    assert run_virtual(lambda clock: main(clock, 8.0)) == pytest.approx(0.4, abs=1e-6)


def test_boards_are_factors():
    assert [factor_of(name) for name in ("xu4", "pi2")] == [BOARDS["xu4"], BOARDS["pi2"]]
    assert 1.0 < factor_of("xu4") < factor_of("pi2")
    assert factor_of(3.5) == 3.5
