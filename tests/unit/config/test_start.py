"""A daemon starts without what is damaged of its own files, stopped, and keeps the damaged ones."""

import asyncio
import os
from pathlib import Path

import pytest

from monstertruck_runtime import small_files
from monstertruck_runtime.clock import VirtualClock, run_virtual
from monstertruck_runtime.errors import ConfigError, UnusableFileError
from monstertruck_runtime.threads import inline
from monstertruck_schemas.state import GateMode
from monstertruckd.config.load import SavedSettings, calibrated, load_config
from monstertruckd.config.start import LeftOut, set_aside, started
from monstertruckd.daemon import Daemon
from monstertruckd.tools.simulation.config import SimulatedTruckConfig
from tests.unit.config.test_corrupt_calibration import CONFIG, KINDS, saved

SETTINGS = {
    "empty value": b"gate: {speed: }\n",
    "zeros, as after a loss of power": bytes(60),
    "not YAML": b"gate: [\n",
    "not UTF-8": b"gate: {speed: \xe4}\n",
    "no setting": b"gate: {spees: 0.2}\n",
    "no number": b"gate: {speed: 0/2}\n",
    "beyond its limit": b"gate: {speed: 1e9}\n",
    "a list": b"[gate]\n",
}


@pytest.fixture
def loaded(tmp_path: Path):
    file = tmp_path / "truck.yaml"
    places = f"calibration: {tmp_path / 'calibration'}\nstate_directory: {tmp_path / 'state'}\n"
    file.write_text(f"include: {CONFIG}\nversion: 2\nrobot: truck\n{places}")
    return load_config(file, SimulatedTruckConfig)


def settings(tmp_path: Path, content: bytes) -> Path:
    file = SavedSettings(tmp_path / "state", "truck").path
    file.parent.mkdir(exist_ok=True)
    file.write_bytes(content)
    return file


def aside(left_out: tuple[LeftOut, ...], *, stored: bool = True) -> tuple[LeftOut, ...]:
    async def store() -> bool:
        assert all(os.path.lexists(one.file) for one in left_out), "renamed before the stop is stored"
        return stored

    return asyncio.run(set_aside(left_out, store, inline))


def test_what_is_sound_counts(loaded, tmp_path):
    saved(tmp_path / "calibration")
    settings(tmp_path, b"gate: {speed: 0.2}\n")
    config, tree, left_out = started(*loaded)
    assert left_out == ()
    assert (config, tree) == calibrated(*loaded)
    assert (config.gate.speed, config.geometry.drive_ratio) == (0.2, 640.0)


@pytest.mark.parametrize("kind", SETTINGS)
def test_without_damaged_settings_those_of_the_configuration_count(loaded, tmp_path, kind):
    saved(tmp_path / "calibration")
    file = settings(tmp_path, SETTINGS[kind])
    config, _, unusable = started(*loaded)
    (left_out,) = aside(unusable)
    assert config.gate.speed == loaded[0].gate.speed
    assert config.geometry.drive_ratio == 640.0
    assert left_out.source == "gate"
    assert str(file) in left_out.text
    assert "the file is kept as settings-truck.yaml.damaged" in left_out.text
    assert file.with_name(file.name + ".damaged").read_bytes() == SETTINGS[kind]
    SavedSettings(file.parent, "truck").save({"gate.speed": 0.15})
    config, _, none = started(*loaded)
    assert (config.gate.speed, none) == (0.15, ())


def test_a_file_that_cannot_be_renamed_is_left_out_all_the_same(loaded, tmp_path, monkeypatch):
    file = settings(tmp_path, b"[")

    def refuse(*_: object) -> None:
        raise OSError(30, "Read-only file system")

    monkeypatch.setattr(small_files.Path, "rename", refuse)
    (left_out,) = aside(started(*loaded)[2])
    assert left_out.text.endswith("the file cannot be renamed: Read-only file system")
    assert file.exists()


@pytest.mark.parametrize("kind", [kind for kind in KINDS if kind != "of another truck"])
def test_without_a_damaged_calibration_the_one_before_it_counts(loaded, tmp_path, kind):
    path = saved(tmp_path / "calibration")
    KINDS[kind](path)
    settings(tmp_path, b"gate: {speed: 0.2}\n")
    with pytest.raises(UnusableFileError):
        calibrated(*loaded)
    config, tree, unusable = started(*loaded)
    (left_out,) = aside(unusable)
    assert tree.calibration is not None
    assert tree.calibration.name.startswith("0001-")
    assert (config.gate.speed, config.geometry.drive_ratio) == (0.2, 640.0)
    assert left_out.source == "calibration"
    assert str(path) in left_out.text
    assert not path.exists()
    assert path.with_name(path.name + ".damaged").lstat()


def test_a_start_that_dies_before_the_stop_is_stored_leaves_the_file_to_the_next_one(loaded, tmp_path):
    file = settings(tmp_path, b"[")
    _, _, left_out = started(*loaded)
    assert [one.file for one in left_out] == [file]
    assert started(*loaded)[2] == left_out
    (kept,) = aside(left_out, stored=False)
    assert kept.text.endswith("; the file remains until the stop can be stored")
    assert started(*loaded)[2] == left_out
    aside(left_out)
    assert started(*loaded)[2] == ()


def test_without_any_sound_calibration_the_robot_is_as_configured(loaded, tmp_path):
    saved(tmp_path / "calibration")
    for path in (tmp_path / "calibration").glob("0*"):
        path.write_bytes(bytes(100))
    config, tree, left_out = started(*loaded)
    assert len(left_out) == 2
    assert tree.calibration is None
    assert config == loaded[0]


def test_the_calibration_of_another_truck_is_a_mistake_not_damage(loaded, tmp_path):
    path = saved(tmp_path / "calibration")
    KINDS["of another truck"](path)
    with pytest.raises(ConfigError, match="calibration of 'lorry'"):
        started(*loaded)
    assert path.exists()


def test_a_start_without_a_file_is_stopped_until_an_operator_clears_it(loaded, tmp_path):
    config = loaded[0].model_copy(update={"runtime_directory": tmp_path})

    async def main(clock: VirtualClock) -> None:
        assert Daemon(config, clock).gate.mode is GateMode.DISARMED
        left_out = [LeftOut(tmp_path / "settings", "gate", "the settings are damaged")]
        assert Daemon(config, clock, left_out=left_out).gate.mode is GateMode.ESTOPPED

    run_virtual(main)
