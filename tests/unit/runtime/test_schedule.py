import asyncio

from monstertruck_runtime.clock import SECOND, run_virtual
from monstertruck_runtime.schedule import Schedule

TENTH = SECOND // 10


def test_instants_stay_on_the_grid_whatever_the_work_takes():
    async def main(clock):
        start = clock.now()
        schedule = Schedule(clock, 10)
        dues = []
        for work in (0.0, 0.03, 0.09, 0.25, 0.0, 0.2):
            dues.append(await schedule.next() - start)
            assert 0 <= clock.now() - start - dues[-1] < 1000
            await asyncio.sleep(work)
        return dues

    assert run_virtual(main) == [0, TENTH, 2 * TENTH, 3 * TENTH, 6 * TENTH, 7 * TENTH]


def test_the_first_instant_is_now():
    async def main(clock):
        schedule = Schedule(clock, 50)
        assert await schedule.next() == clock.now()

    run_virtual(main)
