"""One more sensor, motor controller, body, wizard, task, pane: each is tried in a copy of the packages, and works."""

from pathlib import Path

import pytest

from benchmarks.house import PLACES
from tests.trial_changes import TRIALS

pytestmark = [pytest.mark.virtual, pytest.mark.long, pytest.mark.timeout(180)]


@pytest.mark.parametrize("kind", TRIALS)
def test_it_works_and_changes_few_files(kind: str, tmp_path: Path):
    trial = TRIALS[kind]()
    trial.run(tmp_path)
    assert len(trial.places) <= PLACES[kind], trial.places
    assert len({Path(name).parent for name in trial.own}) == 1, "its own files are in one place"
