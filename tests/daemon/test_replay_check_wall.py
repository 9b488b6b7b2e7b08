"""A drive with mapping, recorded on the wall clock, computed again."""

import asyncio
from pathlib import Path

import pytest

from monstertruck_schemas import topics
from monstertruckd.tools.replay_check import check_log
from tests.daemon.wall_kit import ROOT, end, robot

pytestmark = [pytest.mark.wall, pytest.mark.timeout(180)]


@pytest.mark.long
async def test_what_the_loop_computed_comes_again_bit_for_bit(tmp_path: Path):
    async with robot(tmp_path, {"map": None}, base=ROOT / "configs" / "slam.yaml") as made:
        await made.start_simulator()
        await made.start_daemon()
        async with made.client() as client:
            await made.drive(client, speed=0.05)
            await asyncio.sleep(4)
        assert await end(made.daemon) == 0
        (log,) = made.logs()
    check = await asyncio.to_thread(check_log, log)
    rows = {row.topic: row for row in check.topics}
    for topic in (topics.SCAN, topics.ODOMETRY):
        assert rows[topic].equal == rows[topic].compared > 40
        assert rows[topic].missing == rows[topic].surplus(check.end) == 0
    for topic in (topics.POSE, topics.TRANSFORMS):
        assert rows[topic].agrees(check.end), rows[topic].greatest
    assert rows[topics.SLAM].compared > 20
    assert not rows[topics.SLAM].judged
