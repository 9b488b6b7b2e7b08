import asyncio
from itertools import pairwise

import pytest

from monstertruck_runtime.clock import MILLISECOND, SECOND, Lead, Schedule, run_virtual, run_wall

TENTH = SECOND // 10


def test_instants_stay_on_the_grid_whatever_the_work_takes():
    async def main(clock):
        start = clock.now()
        schedule = Schedule(clock, 10, ahead=0)
        dues = []
        for work in (0.0, 0.03, 0.09, 0.25, 0.0, 0.2, 0.1005, 0.102, 0.0):
            dues.append(await schedule.next() - start)
            assert 0 <= clock.now() - start - dues[-1] < MILLISECOND
            await asyncio.sleep(work)
        return dues

    assert run_virtual(main) == [tenth * TENTH for tenth in (0, 1, 2, 3, 6, 7, 9, 10, 12)]


def test_who_waits_by_himself_goes_on_at_once_when_late_and_comes_back_to_the_grid():
    async def main(clock):
        start = clock.now()
        schedule = Schedule(clock, 10, ahead=0)
        begun = []
        for work in (0.0, 0.03, 0.09, 0.25, 0.0, 0.12, 0.0, 0.0):
            await clock.sleep_until(schedule.step())
            begun.append(round((clock.now() - start) / MILLISECOND))
            await asyncio.sleep(work)
        return begun

    assert run_virtual(main) == [0, 100, 200, 300, 550, 600, 720, 800]


def test_the_first_instant_is_now():
    async def main(clock):
        schedule = Schedule(clock, 50)
        assert await schedule.next() == clock.now()

    run_virtual(main)


def test_services_that_began_at_different_times_wake_together_ahead_of_the_gate():
    async def main(clock):
        async def three(rate, **options):
            schedule = Schedule(clock, rate, **options)
            return [await schedule.next() - SECOND for _ in range(3)][1:]

        begun = []
        for rate, options in ((50, {}), (50, {}), (25, {}), (50, {"ahead": 0})):
            begun.append(asyncio.create_task(three(rate, **options)))
            await clock.sleep(0.0037)
        return [[due / MILLISECOND for due in await task] for task in begun]

    ahead = Lead.BEFORE_GATE / MILLISECOND
    assert run_virtual(main, start=SECOND + 123_456) == [
        [20 - ahead, 40 - ahead],
        [20 - ahead, 40 - ahead],
        [40 - ahead, 80 - ahead],
        [40, 60],
    ]


def test_estimates_come_before_who_uses_them_and_threads_behind_the_gate():
    async def main(clock):
        schedules = [Schedule(clock, 50, ahead) for ahead in (Lead.ESTIMATES, Lead.BEFORE_GATE, 0, Lead.IN_THREADS)]
        for schedule in schedules:
            await schedule.next()
        return [await schedule.next() for schedule in schedules]

    estimate, other, gate, thread = run_virtual(main, start=SECOND - 10 * MILLISECOND)
    assert gate % (20 * MILLISECOND) == 0
    assert estimate < other < gate < thread <= estimate + 10 * MILLISECOND


@pytest.mark.parametrize("rate", [1, 3, 15, 30, 50, 400])
@pytest.mark.parametrize("fraction", [0.0, 0.3, 0.49, 0.51, 0.999])
def test_no_two_instants_come_in_quick_succession(rate, fraction):
    async def main(clock):
        await clock.sleep(fraction / rate)
        schedule = Schedule(clock, rate)
        first = await schedule.next()
        times = [first] + [(await schedule.next(), clock.now())[1] for _ in range(4)]
        return [later - earlier for earlier, later in pairwise(times)]

    steps = run_virtual(main, start=SECOND + 333_333_320)
    period = SECOND / rate
    assert 0.49 * period <= steps[0] <= 1.5 * period + MILLISECOND
    assert steps[1:] == pytest.approx([period] * 3, abs=2)


@pytest.mark.parametrize("seconds", [0.0, 0.0002, 0.0007, 0.0031])
def test_a_sleep_on_the_wall_clock_is_never_too_short(seconds):
    async def main(clock):
        short = []
        for _ in range(50):
            begin = clock.now()
            await clock.sleep(seconds)
            short.append(begin + seconds * SECOND - clock.now())
        return max(short)

    assert run_wall(main) <= 0


def test_a_sleep_of_no_time_lets_the_others_run():
    async def main(clock):
        turns = []

        async def other():
            turns.append("other")

        task = asyncio.create_task(other())
        await clock.sleep(0.0)
        turns.append("slept")
        await task
        return turns

    assert run_wall(main) == ["other", "slept"]
