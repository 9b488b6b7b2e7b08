"""Replay of a log on Zenoh, on the log's own clock."""

import asyncio
from collections.abc import Callable, Collection
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

from monstertruck_runtime.clock import ReplayClock, run_replay
from monstertruck_runtime.errors import ConfigError, InputError
from monstertruck_schemas.roles import AccessRole
from monstertruck_schemas.topics import BY_NAME
from monstertruckd.bus.local import Bus
from monstertruckd.bus.rpc import Rpc
from monstertruckd.bus.zenoh_config import ZenohConfig
from monstertruckd.bus.zenoh_session import ZenohBridge
from monstertruckd.recorder.reader import LogReader, attached_values, open_log
from monstertruckd.tools.logs.messages import Selection, first_offset


def replay_log(
    log: str | Path | LogReader,
    robot: str,
    endpoint: str,
    speed: float,
    topics: Collection[str] | None,
    progress: Callable[[float], None] = lambda _: None,
) -> int:
    """Publish the messages of ``log`` at their own times; return their number.

    Requests are omitted, because they were sent to the daemon, not by it.

    Args:
        log: file to read; messages of other schemas are skipped.
        robot: name to publish under.
        endpoint: endpoint to listen on.
        speed: multiple of real time.
        topics: topics to publish; None: all.
        progress: called with the bytes of the log read so far.

    Raises:
        NotFoundError: no such log, or an unknown topic.
        InputError: the log holds no message to replay.
        BusyError: the endpoint is in use.
    """
    selection = Selection(tuple(topics or ()))
    reader = open_log(log)
    start = next((message.log_time for message in reader), None)
    if start is None:
        raise InputError(f"{reader.path}: contains no messages" + (f"; {reader.damage}" if reader.damage else ""))

    async def main(clock: ReplayClock) -> int:
        bus = Bus(clock)
        bridge = ZenohBridge(robot, bus, ZenohConfig(listen=(endpoint,)), clock, _rpc(clock, reader))
        await bridge.open()
        serving = asyncio.Event()
        task = asyncio.create_task(bridge.run(serving.set))
        waiting = asyncio.create_task(serving.wait())
        try:
            await asyncio.wait([waiting, task], return_when=asyncio.FIRST_COMPLETED)
            if task.done():
                task.result()
            count = 0
            for entry, message in selection.of(reader):
                topic = BY_NAME[entry.topic]
                if topic.inward:
                    continue
                progress(reader.position)
                await clock.sleep_until(entry.log_time)
                bus.hand_over(topic, message)
                count += 1
            if not count:
                raise InputError(f"{reader.path}: {selection.nothing}")
            return count
        finally:
            for job in (waiting, task):
                job.cancel()
            await asyncio.wait([waiting, task])

    offset = first_offset(reader.path, reader.metadata().get("run", {}))
    return run_replay(main, start=start, real_offset=offset, rate=speed)


def _rpc(clock: ReplayClock, reader: LogReader) -> Rpc:
    """Answer a station's calls with the configuration and versions attached to the log."""
    rpc = Rpc(clock)
    attached = {"config": reader.config()}
    with suppress(InputError, ConfigError):  # only people read them
        attached["versions"] = attached_values(reader.path, reader.attachments(), "versions.json") or {}
    for name, value in attached.items():
        if value:
            rpc.register(name, partial(_answer, value), AccessRole.OBSERVER)
    return rpc


async def _answer(value: dict[str, Any], _: dict[str, Any]) -> dict[str, Any]:
    return value
