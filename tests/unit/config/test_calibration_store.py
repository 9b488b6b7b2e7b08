"""The folder of calibration files: whole after any crash, the one before kept, undone by a newer one."""

import os
import tempfile
import threading
from pathlib import Path

import pytest

from monstertruck_runtime.clock import SECOND
from monstertruck_runtime.errors import ConfigError, NotFoundError
from monstertruckd.config import calibration
from monstertruckd.config.calibration import CalibrationStore, Estimate, Result, in_order, with_values
from monstertruckd.config.load import load_config
from monstertruckd.config.truck import TruckConfig

NOON = 1_795_262_400 * SECOND


def ratio(value: float) -> Result:
    estimate = Estimate(
        name="drive_ratio",
        value=value,
        low=value - 1,
        high=value + 1,
        samples=4,
        meaning="test",
        key="geometry.drive_ratio",
    )
    return Result(wizard="drive", measured="taped", estimates=(estimate,))


def gain(value: float) -> Result:
    estimate = Estimate(name="gain", value=value, samples=1, meaning="test")
    return Result(wizard="battery", measured="metered", estimates=(estimate,))


@pytest.fixture
def store(tmp_path: Path) -> CalibrationStore:
    return CalibrationStore(tmp_path / "state" / "calibration", "truck")


def value(store: CalibrationStore, wizard: str = "drive"):
    current = store.current()
    assert current is not None
    result = current.results.get(wizard)  # type: ignore[call-overload]
    return None if result is None else result.estimates[0].value


def test_files_are_dated_numbered_and_all_kept(store: CalibrationStore):
    assert store.newest() is None
    assert store.current() is None
    first = store.save(ratio(640.0), NOON)
    second = store.save(gain(1.02), NOON + 90 * SECOND)
    assert [path.name for path in store.files()] == ["0001-2026-11-21T120000Z.json", "0002-2026-11-21T120130Z.json"]
    assert store.newest() == second
    assert store.load(first).results.keys() == {"drive"}
    current = store.current()
    assert current is not None
    assert current.results["drive"].date == "2026-11-21T12:00:00Z"
    assert current.results["battery"].date == "2026-11-21T12:01:30Z"
    assert current.change == "battery calibrated"


def test_a_partial_result_keeps_what_it_did_not_measure(store: CalibrationStore):
    store.save(ratio(640.0), NOON)
    sign = Estimate(name="inverted", value=True, samples=1, meaning="test")
    store.save(Result(wizard="drive", measured="seen", estimates=(sign,), partial=True), NOON + 60 * SECOND)
    current = store.current()
    assert current is not None
    dates = {estimate.name: estimate.date for estimate in current.results["drive"].estimates}
    assert dates == {"inverted": "2026-11-21T12:01:00Z", "drive_ratio": "2026-11-21T12:00:00Z"}
    store.save(ratio(650.0), NOON + 120 * SECOND)
    current = store.current()
    assert current is not None
    assert [estimate.name for estimate in current.results["drive"].estimates] == ["drive_ratio"], "all was measured"
    store.undo("drive", NOON)
    assert value(store) is True


def test_a_sign_alone_does_not_bring_back_a_ratio_that_another_wizard_measured_since(store: CalibrationStore):
    config = load_config(Path(__file__).resolve().parents[3] / "configs" / "truck.yaml", TruckConfig)[0]

    def used() -> float:
        current = store.current()
        assert current is not None
        return with_values(config, current.results.values(), "test").geometry.drive_ratio

    squares = ratio(650.0).model_copy(update={"wizard": "odometry"})
    sign = Estimate(name="inverted", value=True, samples=1, meaning="test")
    store.save(ratio(640.0), NOON)
    store.save(squares, 0)  # a robot without a clock of its own
    store.save(Result(wizard="drive", measured="seen", estimates=(sign,), partial=True), NOON)
    assert used() == 650.0
    store.undo("odometry", NOON)
    assert used() == 640.0
    store.undo("odometry", NOON)
    store.save(ratio(645.0), NOON)
    assert used() == 645.0


def test_of_files_of_older_releases_the_dates_decide(store: CalibrationStore):
    rows = [("drive", 640.0, "2026-11-21T12:00:00Z"), ("odometry", 650.0, "2026-11-21T13:00:00Z")]
    results = []
    for wizard, value_, date in rows:
        found = ratio(value_)
        dated = tuple(e.model_copy(update={"date": date}) for e in found.estimates)
        results.append(found.model_copy(update={"wizard": wizard, "estimates": dated}))
    assert [row.wizard for row, _, _ in in_order(reversed(results))] == ["drive", "odometry"]


def test_numbers_decide_not_dates(store: CalibrationStore):
    store.save(ratio(640.0), NOON)
    store.save(ratio(650.0), 0)  # a robot without a clock of its own
    assert value(store) == 650.0


def test_undo_returns_to_the_value_before_and_twice_is_redo(store: CalibrationStore):
    store.save(ratio(640.0), NOON)
    store.save(ratio(650.0), NOON)
    store.save(gain(1.02), NOON)
    store.undo("drive", NOON)
    assert (value(store), value(store, "battery")) == (640.0, 1.02), "only what was asked for"
    store.undo("drive", NOON)
    assert value(store) == 650.0
    store.undo("battery", NOON)
    assert value(store, "battery") is None
    assert len(store.files()) == 6, "nothing is ever lost"


def test_nothing_to_undo(store: CalibrationStore):
    store.save(ratio(640.0), NOON)
    with pytest.raises(NotFoundError, match="battery was never calibrated"):
        store.undo("battery", NOON)


@pytest.mark.parametrize("step", ["mkstemp", "fsync", "replace"])
def test_a_failure_while_writing_leaves_the_old_file(
    step: str, store: CalibrationStore, monkeypatch: pytest.MonkeyPatch
):
    store.save(ratio(640.0), NOON)
    before = {path: path.read_bytes() for path in store.files()}

    def full(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as broken:
        broken.setattr({"mkstemp": tempfile, "fsync": os, "replace": Path}[step], step, full)
        with pytest.raises(ConfigError, match="No space left on device"):
            store.save(ratio(650.0), NOON)
    assert {path: path.read_bytes() for path in store.files()} == before
    assert value(store) == 640.0


def test_two_writers_of_one_folder_keep_what_the_other_measured(
    store: CalibrationStore, monkeypatch: pytest.MonkeyPatch
):
    other, put = CalibrationStore(store.folder, "truck"), calibration.replace_file
    second = threading.Thread(target=other.save, args=(gain(1.02), NOON))

    def meanwhile(path: Path, data: str) -> None:
        monkeypatch.setattr(calibration, "replace_file", put)
        second.start()
        second.join(0.1)
        put(path, data)

    monkeypatch.setattr(calibration, "replace_file", meanwhile)
    store.save(ratio(640.0), NOON)
    second.join()
    assert [path.name[:4] for path in store.files()] == ["0001", "0002"]
    assert (value(store), value(store, "battery")) == (640.0, 1.02)


def test_a_torn_draft_is_no_calibration(store: CalibrationStore):
    path = store.save(ratio(640.0), NOON)
    (store.folder / "0002-2026-11-21T120130Z.json.x1.new~").write_text('{"version": 1, "num')
    assert store.newest() == path
    store.save(ratio(650.0), NOON + 90 * SECOND)
    assert value(store) == 650.0


def test_a_damaged_file_is_named_with_the_way_back(store: CalibrationStore):
    path = store.save(ratio(640.0), NOON)
    path.write_text(path.read_text()[:100])
    with pytest.raises(ConfigError, match=rf"{path}: no usable calibration: Invalid JSON: .*; move it away"):
        store.current()


def test_another_trucks_file_is_refused(store: CalibrationStore):
    store.save(ratio(640.0), NOON)
    with pytest.raises(ConfigError, match="calibration of 'truck', expected 'lorry'"):
        CalibrationStore(store.folder, "lorry").current()


def test_of_two_wizards_that_set_one_value_the_newer_counts(store: CalibrationStore):
    squares = ratio(620.0).model_copy(update={"wizard": "odometry"})
    truck = load_config(Path(__file__).resolve().parents[3] / "configs" / "truck.yaml", TruckConfig)[0]

    def counted() -> float:
        current = store.current()
        assert current is not None
        return with_values(truck, current.results.values(), "test").geometry.drive_ratio

    for result, expected in ((ratio(640.0), 640.0), (squares, 620.0), (ratio(641.0), 641.0)):
        store.save(result, NOON)
        assert counted() == expected
    store.undo("drive", NOON)
    store.undo("odometry", NOON)
    assert counted() == 640.0
