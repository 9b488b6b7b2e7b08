"""Steps of the real time under a virtual clock."""

from monstertruck_runtime.clock import SECOND, run_virtual


def test_the_real_time_steps_and_the_monotonic_one_does_not():
    async def main(clock):
        before = clock.now()
        clock.step_real(3600.0)
        clock.step_real(-0.5)
        return clock.now() - before, clock.real_offset()

    assert run_virtual(main) == (0, round(3599.5 * SECOND))
