"""Ticks of odometry before its first output, which no log holds."""

import pytest

from monstertruck_runtime.clock import SECOND
from monstertruck_schemas import topics
from monstertruckd.recorder.reader import LogMessage
from monstertruckd.tools.replay_check.chain import unseen_ticks
from monstertruckd.tools.replay_check.recorded import RunLog, Survey, recorded_config
from tests.unit.tools.replay_check.log_surgery import LEVEL

PERIOD = SECOND // 50


def survey(drive: int, odometry: int) -> Survey:
    """Of a log that begins at 1 s and has its first reading of the drive and its first odometry then, ns."""
    times = {topics.TRANSFORMS: SECOND, topics.DRIVE: drive, topics.ODOMETRY: odometry}
    first = {topic.name: LogMessage(topic.name, at, at, 0, b"", "") for topic, at in times.items()}
    return Survey(SECOND, 2 * SECOND, first=first)


@pytest.mark.parametrize(
    ("late", "expected"),
    [
        (0, [SECOND + k * PERIOD for k in (4, 3, 2, 1, 0)]),
        # The tick after the reading at 1.081 s came at 1.135 s: the one at 1.115 s of the grid is none.
        (35_000_000, [SECOND + 15_000_000 + k * PERIOD for k in (3, 2, 1, 0)]),
    ],
)
def test_none_comes_between_the_first_reading_and_the_first_output(late: int, expected: list[int]):
    config = recorded_config(LEVEL, RunLog(LEVEL).first.attachments())
    assert config.odometry.rate == 50
    log = survey(SECOND + 81_000_000, SECOND + 100_000_000 + late)
    assert [tick for tick, service in unseen_ticks(config, log) if service == "odometry"] == expected
