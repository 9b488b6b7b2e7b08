"""A black box begins in the middle of a run: its run is computed again, up to the end of the box."""

from pathlib import Path

import pytest

from monstertruck_runtime.clock import SECOND
from monstertruck_runtime.errors import InputError
from monstertruckd.recorder.reader import open_log
from monstertruckd.tools.replay_check import check_log, run_of
from tests.unit.tools.replay_check.log_surgery import LEVEL, attachments_of, computed_again, write


@pytest.fixture
def box(tmp_path: Path) -> Path:
    """Two seconds from the middle of a stored run, whose log is in the folder above."""
    messages = list(open_log(LEVEL))
    begin = messages[0].log_time
    (tmp_path / "logs/blackbox").mkdir(parents=True)
    write(tmp_path / "logs/run-000001-000.mcap", messages, attachments_of(LEVEL))
    middle = [one for one in messages if 2 * SECOND < one.log_time - begin < 4 * SECOND]
    named = "/elsewhere/logs/run-000001-000.mcap"  # the folder was copied
    return write(tmp_path / "logs/blackbox/blackbox-000001-x.mcap", middle, attachments_of(LEVEL), log=named)


def test_a_box_is_checked_with_its_run_up_to_its_end(box: Path, tmp_path: Path):
    run, until = run_of(box)
    assert run == tmp_path / "logs/run-000001-000.mcap"
    assert until == max(one.log_time for one in open_log(box))
    check = computed_again(box)
    assert check.log == run
    assert check.duration == pytest.approx(4.0, abs=0.1)
    assert check.compared == check.equal + sum(row.compared - row.equal for row in check.topics)
    assert check.compared > 50
    assert check.reason.exit_code == 0


def test_a_log_stands_for_itself():
    assert run_of(LEVEL) == (LEVEL, None)


def test_a_box_whose_run_is_gone_says_so(box: Path, tmp_path: Path):
    (tmp_path / "logs/run-000001-000.mcap").unlink()
    with pytest.raises(InputError, match=r"starts in the middle of its run, and the run's log /elsewhere/logs/run-"):
        check_log(box)
