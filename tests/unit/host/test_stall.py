"""A control tick that does not come leaves all tracebacks behind."""

import asyncio
import ctypes
import faulthandler
import logging
import time
from pathlib import Path

import pytest

from monstertruck_runtime.clock import WallClock
from monstertruckd.host import stall
from monstertruckd.host.stall import StallWatch

pytestmark = pytest.mark.wall


def a_driver_that_waits_for_its_device(seconds):
    time.sleep(seconds)


def an_extension_that_keeps_the_lock(seconds):
    ctypes.PyDLL(None).usleep(round(seconds * 1e6))  # a PyDLL call holds the interpreter's lock


async def watched(folder, scenario, **settings):
    """Run ``scenario`` during a control tick of 50 Hz."""
    ticks = 0

    async def tick():
        nonlocal ticks
        while True:
            ticks += 1
            await asyncio.sleep(0.02)

    watch = StallWatch(WallClock(), lambda: ticks, folder, **settings)
    tasks = [asyncio.create_task(tick()), asyncio.create_task(watch.run(lambda: None))]
    try:
        await asyncio.sleep(0.15)
        await scenario()
        await asyncio.sleep(0.15)
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.wait(tasks)


def dumps(folder):
    return sorted(folder.glob("stall-*.txt"))


def test_a_blocked_loop_is_dumped_while_it_is_blocked_and_not_again_soon(tmp_path: Path, caplog):
    async def scenario():
        a_driver_that_waits_for_its_device(0.5)
        await asyncio.sleep(0.1)
        a_driver_that_waits_for_its_device(0.4)

    with caplog.at_level(logging.INFO):
        asyncio.run(watched(tmp_path, scenario))
    (file,) = dumps(tmp_path)
    assert file.name == "stall-000001.txt"
    text = file.read_text()
    assert text.startswith("no control tick for 0.")
    assert "a_driver_that_waits_for_its_device" in text
    assert "a_driver_that_waits_for_its_device" in caplog.text
    (dumped,) = (record for record in caplog.records if "all threads" in record.message)
    assert dumped.levelno == logging.ERROR
    assert dumped.brief.endswith(str(file)), "a terminal is not filled with it"
    assert "the control tick is back after 0." in caplog.text


def test_punctual_ticks_leave_nothing(tmp_path: Path):
    asyncio.run(watched(tmp_path, lambda: asyncio.sleep(0.8), stall=0.6))
    assert dumps(tmp_path) == []


def test_a_loop_that_has_not_ticked_yet_is_starting(tmp_path: Path):
    async def main():
        watch = asyncio.create_task(StallWatch(WallClock(), lambda: 0, tmp_path, stall=0.05).run(lambda: None))
        await asyncio.sleep(0.3)
        watch.cancel()
        await asyncio.wait([watch])

    asyncio.run(main())
    assert dumps(tmp_path) == []


def test_no_traceback_is_taken_without_the_interpreters_lock(tmp_path: Path, monkeypatch):
    """Once the cause of crashes: the dump read the stacks of threads that ran on."""
    armed = []
    monkeypatch.setattr(faulthandler, "dump_traceback_later", lambda *_, **__: armed.append(1))

    async def scenario():
        an_extension_that_keeps_the_lock(0.7)
        await asyncio.sleep(0.1)

    asyncio.run(watched(tmp_path, scenario))
    assert not armed
    assert dumps(tmp_path) == []


def test_a_folder_that_cannot_be_written_costs_the_file_only(tmp_path: Path, caplog):
    blocked = tmp_path / "file"
    blocked.touch()

    async def scenario():
        a_driver_that_waits_for_its_device(0.4)

    asyncio.run(watched(blocked, scenario))
    assert "a_driver_that_waits_for_its_device" in caplog.text
    assert "tracebacks are in the log only" in caplog.text


def test_old_dumps_go(tmp_path: Path):
    for number in range(1, stall.KEPT_DUMPS + 6):
        (tmp_path / f"stall-{number:06d}.txt").touch()
    (tmp_path / "notes.txt").touch()

    async def scenario():
        a_driver_that_waits_for_its_device(0.4)

    asyncio.run(watched(tmp_path, scenario))
    files = dumps(tmp_path)
    assert len(files) == stall.KEPT_DUMPS
    assert files[-1].name == f"stall-{stall.KEPT_DUMPS + 6:06d}.txt"
    assert (tmp_path / "notes.txt").exists()
