"""Blocking work that nobody has to wait for."""

import asyncio
import threading

import pytest

from monstertruck_runtime.threads import in_daemon_thread


def test_results_and_errors_come_back_from_a_daemon_thread():
    async def main():
        thread = await in_daemon_thread(threading.current_thread)
        assert thread.daemon
        assert thread is not threading.main_thread()
        with pytest.raises(ZeroDivisionError):
            await in_daemon_thread(lambda: 1 / 0)

    asyncio.run(main())


def test_neither_a_cancelled_caller_nor_the_loops_end_waits_for_work_that_hangs():
    release = threading.Event()

    async def main():
        task = asyncio.create_task(in_daemon_thread(release.wait))
        await asyncio.sleep(0.01)
        task.cancel()
        await asyncio.wait([task])
        assert task.cancelled()

    asyncio.run(main())
    workers = [thread for thread in threading.enumerate() if thread.name == "offloaded"]
    assert len(workers) == 1, "it hangs still"
    release.set()
    workers[0].join()
