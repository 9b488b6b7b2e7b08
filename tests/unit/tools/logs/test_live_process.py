"""The process that draws into rerun's viewer: it runs while a viewer listens, and ends with the station."""

import asyncio
import sys
from contextlib import suppress
from pathlib import Path

from monstertruck_runtime.clock import WallClock
from monstertruckd.tools.logs import live_process

DRAWS = "import sys, time; open(sys.argv[1], 'a').write(' '.join(sys.argv[2:]) + '\\n'); time.sleep(60)"


async def test_it_runs_while_a_viewer_listens_and_the_station_waits_for_neither(tmp_path: Path, monkeypatch):
    monkeypatch.setattr(live_process, "LISTENER_LOOK_PERIOD", 0.05)
    drawn = tmp_path / "drawn"

    def starts() -> int:
        return len(drawn.read_text().splitlines()) if drawn.exists() else 0

    async def until(count: int) -> None:
        async with asyncio.timeout(20):
            while starts() < count:
                await asyncio.sleep(0.02)

    server = await asyncio.start_server(lambda _, writer: writer.close(), "127.0.0.1", 0)
    port = server.sockets[0].getsockname()[1]
    server.close()
    viewer, program = f"rerun+http://127.0.0.1:{port}/proxy", (sys.executable, "-c", DRAWS, str(drawn))
    showing = asyncio.create_task(live_process.show_live("truck", "tcp/x:1", WallClock(), viewer, program))
    await asyncio.sleep(0.2)
    assert starts() == 0, "nobody would look at it"
    for turn in (1, 2):
        server = await asyncio.start_server(lambda _, writer: writer.close(), "127.0.0.1", port)
        await until(turn)
        server.close()
        await asyncio.sleep(0.3)
    server = await asyncio.start_server(lambda _, writer: writer.close(), "127.0.0.1", port)
    await until(3)
    showing.cancel()
    with suppress(asyncio.CancelledError):
        async with asyncio.timeout(2):
            await showing
    server.close()
    assert set(drawn.read_text().splitlines()) == {f"truck tcp/x:1 {viewer}"}
