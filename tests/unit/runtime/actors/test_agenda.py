"""Turns on the virtual clock."""

import asyncio

import pytest

from monstertruck_runtime.actors.agenda import agenda_of
from monstertruck_runtime.clock import SECOND, VirtualClock, run_virtual


def test_turns_due_together_are_taken_in_the_order_of_waiting_and_cancelled_ones_are_skipped():
    async def main(clock: VirtualClock) -> list[int]:
        agenda = agenda_of(clock)
        assert agenda is agenda_of(clock)
        taken: list[int] = []
        same = clock.now() + SECOND

        async def wait(number: int, due: int) -> None:
            await agenda.wait(clock, due)
            assert clock.now() == pytest.approx(due, abs=10)
            taken.append(number)

        tasks = [asyncio.create_task(wait(number, same)) for number in range(50)]
        tasks += [asyncio.create_task(wait(99, same - 1000)), asyncio.create_task(wait(100, same + 1000))]
        await clock.sleep(0.5)
        tasks[7].cancel()
        await asyncio.wait(tasks)
        return taken

    assert run_virtual(main) == [99, *(number for number in range(50) if number != 7), 100]
