"""Services that tick when they ticked before."""

import asyncio

from monstertruck_runtime.actors.actor import delivery_of, use_delivery
from monstertruck_runtime.clock import SECOND, Schedule, VirtualLoop
from monstertruckd.tools.replay_check.pace import Pace, PacedClock, RecordedTurns


def run(main, start=SECOND):
    with asyncio.Runner(loop_factory=lambda: VirtualLoop(start)) as runner:
        return runner.run(main(PacedClock(runner.get_loop())))


def test_a_schedule_ticks_at_the_recorded_instants_and_knows_no_other():
    instants = [SECOND + 3, SECOND + 20_000_777, SECOND + 55_000_000]

    async def main(clock):
        pace, seen = Pace(), []

        async def service():
            pace.adopt()
            schedule = Schedule(clock, 50.0)
            while True:
                await schedule.next()
                seen.append(clock.now())

        task = asyncio.create_task(service())
        for instant in instants:
            await pace.release(instant)
            await pace.release(instant)  # a second output of the same turn
            await asyncio.sleep(0)
            assert seen[-1] == instant
        await clock.reach(10 * SECOND)
        task.cancel()
        return seen

    assert run(main) == instants


def test_others_keep_the_time_of_the_loop_to_the_nanosecond():
    async def main(clock):
        reached = []
        for instant in (SECOND, SECOND + 20_000_001, 3 * SECOND + 7):
            await clock.reach(instant)
            reached.append(clock.now())
        return reached

    assert run(main) == [SECOND, SECOND + 20_000_001, 3 * SECOND + 7]


def test_results_of_workers_count_when_they_are_called_in_their_order():
    async def main(clock):
        turns, reported = RecordedTurns(), []
        use_delivery(clock, turns)

        async def step(name):
            await delivery_of(clock).wait(clock, 2 * SECOND)
            reported.append((name, clock.now()))

        turns.next()  # without waiting
        tasks = [asyncio.create_task(step(name)) for name in "abc"]
        for instant in (5 * SECOND, 6 * SECOND):
            await clock.reach(instant)
            turns.next()
        await asyncio.sleep(0)
        turns.open()
        await asyncio.gather(*tasks)
        await step("d")
        return reported

    assert run(main) == [("a", 5 * SECOND), ("b", 6 * SECOND), ("c", 6 * SECOND), ("d", 6 * SECOND)]
