"""Files of a calibration that are damaged in all ways: one clear line at the start, and never a strange value."""

import json
import os
import random
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from monstertruck_runtime.errors import ConfigError
from monstertruckd.config.calibration import CalibrationStore, Estimate, Result
from monstertruckd.config.load import calibrated, load_config
from monstertruckd.tools.simulation.config import SimulatedTruckConfig

CONFIG = Path(__file__).parents[3] / "configs" / "demo.yaml"


def saved(folder: Path) -> Path:
    """A sound file of two wizards."""
    store = CalibrationStore(folder, "truck")
    for wizard, key, value in (
        ("drive", "geometry.drive_ratio", 640.0),
        ("compass", "devices.compass.driver.iron.hard_x", 12.0),
    ):
        estimate = Estimate(name="x", value=value, samples=4, meaning="test", key=key)
        store.save(Result(wizard=wizard, measured="taped", estimates=(estimate,)), 1_795_262_400_000_000_000)
    newest = store.newest()
    assert newest is not None
    return newest


def edited(change: Callable[[dict[str, Any]], object]) -> Callable[[Path], None]:
    def edit(path: Path) -> None:
        data = json.loads(path.read_text())
        change(data)
        path.write_text(json.dumps(data))

    return edit


def value(wizard: str, new: object, key: str | None = None) -> Callable[[Path], None]:
    def change(data: dict[str, Any]) -> None:
        estimate = data["results"][wizard]["estimates"][0]
        estimate.update({"value": new} | ({"key": key} if key else {}))

    return edited(change)


def instead(make: Callable[[Path], object]) -> Callable[[Path], None]:
    def replace(path: Path) -> None:
        path.unlink()
        make(path)

    return replace


KINDS: dict[str, Callable[[Path], object]] = {
    "empty": lambda path: path.write_bytes(b""),
    "cut": lambda path: path.write_bytes(path.read_bytes()[:300]),
    "zeros, as after a loss of power": lambda path: path.write_bytes(bytes(path.stat().st_size)),
    "random bytes": lambda path: path.write_bytes(random.Random(1).randbytes(2000)),
    "one bit of the syntax": lambda path: path.write_bytes(path.read_bytes().replace(b'"results"', b'"rgsults"')),
    "not UTF-8": lambda path: path.write_bytes(path.read_bytes().replace(b"taped", b"t\xe4ped")),
    "UTF-16": lambda path: path.write_text(path.read_text(), encoding="utf-16"),
    "followed by rubbish": lambda path: path.write_bytes(path.read_bytes() + b"}"),
    "a folder": instead(Path.mkdir),
    "a link to nowhere": instead(lambda path: path.symlink_to("nowhere")),
    "a link to a device": instead(lambda path: path.symlink_to("/dev/zero")),
    "a pipe": instead(os.mkfifo),
    "60 MB": lambda path: os.truncate(path, 60_000_000),
    "100 000 brackets": lambda path: path.write_bytes(b"[" * 100_000),
    "of another version": edited(lambda data: data.update(version=2)),
    "of another truck": edited(lambda data: data.update(robot="lorry")),
    "of an unknown wizard": edited(lambda data: data["results"].update(brakes=data["results"]["drive"])),
    "not a number": value("compass", float("nan")),
    "infinite": value("compass", float("inf")),
    "text": value("drive", "640"),
    "negative": value("drive", -640.0),
    "an absurd ratio": value("drive", 1e300),
    "more iron than there is": value("compass", 1e308, "devices.compass.driver.iron.soft_xy"),
    "a key of the gate": value("drive", 9.0, "gate.speed"),
    "a date that is none": edited(lambda data: data["results"]["drive"].update(date="yesterday")),
    "a date of no calendar": edited(lambda data: data["results"]["drive"].update(date="2026-99-99T00:00:00Z")),
    "a key that is not there": value("drive", 9.0, "geometry.drive"),
}


@pytest.mark.parametrize("kind", KINDS)
def test_a_corrupt_calibration_is_one_clear_line_at_the_start(kind: str, tmp_path: Path):
    file = tmp_path / "truck.yaml"
    file.write_text(f"include: {CONFIG}\nversion: 2\nrobot: truck\ncalibration: {tmp_path / 'calibration'}\n")
    path = saved(tmp_path / "calibration")
    loaded = load_config(file, SimulatedTruckConfig)
    assert calibrated(*loaded)[0].geometry.drive_ratio == 640.0
    KINDS[kind](path)
    began = time.process_time()
    with pytest.raises(ConfigError) as refused:
        calibrated(*loaded)
    assert time.process_time() - began < 1.0
    text = str(refused.value)
    assert str(path) in text
    assert "\n" not in text
    assert len(text) < len(str(path)) + 300
