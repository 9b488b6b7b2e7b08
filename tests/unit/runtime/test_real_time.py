"""Steps of the real time under a virtual clock."""

import time

from monstertruck_runtime.clock import SECOND, minute_of_day, run_virtual


def test_the_real_time_steps_and_the_monotonic_one_does_not():
    async def main(clock):
        before = clock.now()
        clock.step_real(3600.0)
        clock.step_real(-0.5)
        return clock.now() - before, clock.real_offset()

    assert run_virtual(main) == (0, round(3599.5 * SECOND))


def test_the_time_of_day_is_that_of_the_computers_zone_and_needs_a_date(monkeypatch):
    noon = 1_700_000_000 // 86400 * 86400 + 43_200
    try:
        for zone, minute in (("UTC", 720), ("UTC-2", 840)):
            monkeypatch.setenv("TZ", zone)
            time.tzset()
            assert minute_of_day(noon * SECOND + 1) == minute
    finally:
        monkeypatch.undo()
        time.tzset()
    assert minute_of_day(43_200 * SECOND) is None
