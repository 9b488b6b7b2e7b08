"""What a daemon removes at its start, and what it leaves."""

import logging
import shutil
from pathlib import Path

import pytest

from monstertruck_runtime.small_files import SCRATCH
from monstertruckd import run
from monstertruckd.config.load import load_truck
from monstertruckd.run import clean_up

CONFIG = Path(__file__).resolve().parents[3] / "configs" / "slam.yaml"


def test_files_of_killed_programs_are_removed_at_the_start_and_nothing_else(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
):
    config, _ = load_truck(CONFIG)
    assert config.slam is not None
    state, saves = tmp_path / "state", tmp_path / "map" / "saves"
    slam = config.slam.model_copy(update={"save": tmp_path / "map"})
    config = config.model_copy(update={"state_directory": state, "slam": slam})
    clean_up(config)
    left = [state / f"estop.a{SCRATCH}", state / "calibration" / f"0001.json.b{SCRATCH}", saves / f"tmp{SCRATCH}"]
    kept = [state / "estop", state / "calibration" / "0001.json", saves / "000001"]
    for path in (*left[:2], *kept[:2]):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()
    for path in (left[2], kept[2]):
        path.mkdir(parents=True)
    with caplog.at_level(logging.INFO):
        clean_up(config)
    assert all(path.exists() for path in kept)
    assert not any(path.exists() for path in left)
    assert [record.getMessage().partition(":")[0] for record in caplog.records] == [str(path) for path in left]
    caplog.clear()

    def refuse(folder: Path) -> list[Path]:
        raise PermissionError(13, "Permission denied")

    left[2].mkdir()
    monkeypatch.setattr(run, "remove_leftovers", refuse)
    clean_up(config)
    assert not left[2].exists(), "the others are cleaned all the same"
    said = [record.getMessage() for record in caplog.records if record.levelno == logging.WARNING]
    assert len(said) == 2
    assert said[0] == f"{state}: files of killed programs cannot be removed: Permission denied"
    shutil.rmtree(state)
