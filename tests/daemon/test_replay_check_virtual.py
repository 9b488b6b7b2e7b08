"""What a whole daemon recorded on the virtual clock comes again bit for bit."""

import pytest

from monstertruckd.tools.replay_check import check_log
from tests.long_kit import mostly_long
from tests.make_replay_logs import RUNS, record

pytestmark = [pytest.mark.virtual, pytest.mark.timeout(300)]


@pytest.mark.parametrize("name", mostly_long([*RUNS, "goals"], {"fusion"}))
def test_a_fresh_run_comes_again(tmp_path, name):
    record(name, tmp_path / "run.mcap")
    check = check_log(tmp_path / "run.mcap")
    assert check.agrees, check.first
    assert check.equal == check.compared >= 1000
    assert check.lost == {}
