"""Blocking work that nobody has to wait for."""

import asyncio
import queue
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
    release, threads = threading.Event(), queue.SimpleQueue()

    def hang():
        threads.put(threading.current_thread())
        release.wait()

    async def main():
        task = asyncio.create_task(in_daemon_thread(hang))
        await asyncio.sleep(0.01)
        task.cancel()
        await asyncio.wait([task])
        assert task.cancelled()

    asyncio.run(main())
    thread = threads.get(timeout=10)
    assert thread.is_alive(), "it hangs still"
    release.set()
    thread.join()
