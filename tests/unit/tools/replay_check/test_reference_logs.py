"""Recorded runs computed again: all of it equal, and nothing that was changed stays unfound."""

import json
import math
from dataclasses import replace

import pytest
from typer.testing import CliRunner

from monstertruck_runtime import wire
from monstertruck_runtime.errors import InputError
from monstertruck_schemas import topics
from monstertruck_schemas.reasons import Reason
from monstertruckd.recorder.reader import open_log
from monstertruckd.tools.cli.main import app
from monstertruckd.tools.replay_check import check_log
from monstertruckd.tools.replay_check.comparison import Kind
from tests.unit.tools.replay_check.log_surgery import (
    FUSION,
    GOALS,
    LEVEL,
    SLAM,
    attachments_of,
    changed,
    chunks,
    computed_again,
    digit,
    flip,
)

pytestmark = pytest.mark.timeout(120)


@pytest.mark.parametrize(
    ("log", "computed"),
    [
        (LEVEL, {topics.SCAN, topics.PLAN_STABILISER, topics.ODOMETRY, topics.POSE, topics.TRACKER}),
        (SLAM, {topics.SLAM, topics.MAP, topics.MAP_TILES, topics.POSE, topics.TRANSFORMS, topics.PLAN_DRIVE}),
        (FUSION, {topics.ODOMETRY, topics.FUSION, topics.SCAN_MOTION, topics.POSE}),
        (GOALS, {topics.GOAL, topics.PATH, topics.TRACKER, topics.PLAN_DRIVE, topics.MAP, topics.POSE}),
    ],
    ids=["level", "slam", "fusion", "goals"],
)
def test_a_stored_run_comes_again(log, computed):
    check = computed_again(log)
    assert check.agrees, check.first
    assert not any(row.headers for row in check.topics)
    assert check.compared >= 1000
    assert check.reason is Reason.OK
    assert {topic.name for topic in computed} <= {row.topic.name for row in check.topics if row.compared}
    recorded = [entry for entry in open_log(log) if entry.topic in {row.topic.name for row in check.topics}]
    assert check.compared == len(recorded)


@pytest.mark.parametrize(
    ("topic", "key", "shown"),
    [
        (topics.DRIVE, "position", topics.ODOMETRY),
        (topics.STEERING, "front", topics.ODOMETRY),
        (topics.COMPASS, "heading", topics.ODOMETRY),
        (topics.COMPASS, "pitch", topics.PLAN_STABILISER),
        (topics.STABILISER, "pitch", topics.SCAN),
    ],
    ids=lambda value: getattr(value, "name", value),
)
def test_one_flipped_byte_is_found_by_what_is_computed_from_it(tmp_path, topic, key, shown):
    number = next(e.sequence for e in open_log(LEVEL) if e.topic == topic.name and e.log_time > 4.5e9)
    log = changed(LEVEL, tmp_path / "flipped.mcap", flip(topic.name, number, digit(key)))
    check = computed_again(log)
    assert check.damage is None
    assert check.reason is Reason.REPLAY_DIFFERS
    (row,) = (row for row in check.topics if row.topic is shown)
    assert row.first is not None
    assert row.first.sequence > 0
    assert 3.4 < check.first.at <= row.first.at < 4.5
    assert row.first.fields


def test_one_flipped_byte_of_a_scan_is_found_by_the_map(tmp_path):
    def byte_of_a_range(payload: bytes) -> int:
        scan = wire.decode(topics.SCAN, payload)
        value = next(r for r in scan.ranges if 0.5 < r < 3.0)
        return payload.index(value.tobytes()) + 6

    log = changed(SLAM, tmp_path / "flipped.mcap", flip("sensor/scan", 30, byte_of_a_range))
    check = computed_again(log)
    assert check.reason is Reason.REPLAY_DIFFERS
    assert check.first.topic in {"health/slam", "state/scan_motion", "state/map_tiles", "state/pose"}
    odometry = next(row for row in check.topics if row.topic is topics.ODOMETRY)
    assert odometry.differing == 0  # it rests on no scan


def test_a_byte_that_makes_a_message_unreadable_is_named(tmp_path):
    log = changed(LEVEL, tmp_path / "broken.mcap", flip("sensor/drive", 20, lambda payload: 0, bit=0x10))
    check = computed_again(log)
    (message,) = check.unreadable
    assert (message.topic, message.sequence) == ("sensor/drive", 20)
    assert check.reason is Reason.REPLAY_DIFFERS


@pytest.mark.parametrize("share", [0.3, 0.6, 0.95])
def test_a_flipped_byte_of_the_file_is_damage(tmp_path, share):
    data = bytearray(LEVEL.read_bytes())
    places = [place for chunk in chunks(data) for place in chunk]
    data[places[int(share * len(places))]] ^= 1
    log = tmp_path / "damaged.mcap"
    log.write_bytes(data)
    check = computed_again(log)
    assert check.reason is Reason.LOG_DAMAGED
    assert "is damaged at byte" in check.damage
    assert check.compared > 100
    assert check.agrees  # as far as it goes


def test_a_changed_output_is_found_as_well(tmp_path):
    log = changed(LEVEL, tmp_path / "other.mcap", flip("plan/drive", 50, digit("front", 3)))
    check = computed_again(log)
    row = next(row for row in check.topics if row.topic is topics.PLAN_DRIVE)
    assert (row.differing, row.first.sequence, row.first.fields) == (1, 50, ("front",))
    assert 0 < row.greatest[Kind.ANGLE].value < 0.01
    assert check_log(log, tolerance=0.01).agrees


def with_drive(log, target, change):
    """``log`` with the 50th message of ``plan/drive`` as ``change`` gives it back."""

    def altered(one):
        if (one.topic, one.sequence) != ("plan/drive", 50):
            return one
        return replace(one, payload=wire.encode(topics.PLAN_DRIVE, change(one.decode())))

    return changed(log, target, altered)


@pytest.mark.parametrize(("by", "rounded"), [(1e-9, True), (1e-5, False)])
def test_last_digits_alone_are_reported_as_such(tmp_path, by, rounded):
    log = with_drive(
        LEVEL, tmp_path / "nudged.mcap", lambda drive: drive.model_copy(update={"front": drive.front + by})
    )
    exact, close = check_log(log), computed_again(log)
    assert not exact.agrees
    assert exact.rounded is exact.figures()["rounded"] is rounded
    assert close.agrees is rounded
    assert (close.first is None) is rounded  # what is within the tolerance is no difference
    assert not close.rounded
    done = CliRunner().invoke(app, ["replay", str(log), "--check"])
    assert done.exit_code == Reason.REPLAY_DIFFERS.exit_code
    assert ("try --tolerance 1e-06" in done.output.replace("\n", " ")) is rounded


def test_another_stamp_is_no_rounding(tmp_path):
    log = with_drive(LEVEL, tmp_path / "late.mcap", lambda drive: drive.model_copy(update={"stamp": drive.stamp + 1}))
    check = check_log(log)
    assert not check.agrees
    assert not check.rounded
    assert [row.topic for row in check.topics if row.headers] == [topics.PLAN_DRIVE]


def test_a_command_that_is_no_number_agrees_with_nothing(tmp_path):
    nan = with_drive(LEVEL, tmp_path / "nan.mcap", lambda drive: drive.model_copy(update={"front": math.nan}))
    check = computed_again(nan)
    assert not check.agrees
    assert not check.rounded
    assert (check.first.topic, check.first.sequence, check.first.fields) == ("plan/drive", 50, ("front",))


def test_a_damaged_configuration_is_not_computed_with(tmp_path):
    log = tmp_path / "damaged.mcap"
    data = LEVEL.read_bytes()
    log.write_bytes(data.replace(b'"wheel_radius"', b'"wheel_radiuS"', 1))
    with pytest.raises(InputError, match=r"damaged\.mcap: config\.json in it is damaged"):
        check_log(log)


def test_a_lost_reading_is_named(tmp_path):
    def lose(one):
        return None if (one.topic, one.sequence) == ("sensor/drive", 60) else one

    check = computed_again(changed(LEVEL, tmp_path / "lossy.mcap", lose))
    assert check.lost == {"sensor/drive": 1}
    assert check.first.topic in {"state/odometry", "state/pose"}


def test_missing_and_extra_outputs_are_counted(tmp_path):
    def without_scans(one):
        return None if one.topic == "sensor/scan" and one.sequence > 40 else one

    check = computed_again(changed(SLAM, tmp_path / "blind.mcap", without_scans))
    rows = {row.topic: row for row in check.topics}
    assert rows[topics.SLAM].missing > 20
    assert not check.agrees
    reported = computed_again(
        changed(SLAM, tmp_path / "reported.mcap", lambda one: None if one.topic == "health/slam" else one)
    )
    assert {row.topic: row for row in reported.topics}[topics.SLAM].surplus(reported.end) > 60
    assert not reported.agrees


def test_another_configuration_shows_what_it_would_have_changed(tmp_path):
    config = attachments_of(LEVEL)["config.json"]
    config["geometry"]["wheel_radius"] *= 1.1
    del config["sim"], config["path"], config["tracker"]
    file = tmp_path / "larger.yaml"
    file.write_text(json.dumps(config))
    check = computed_again(LEVEL, file)
    row = next(row for row in check.topics if row.topic is topics.POSE)
    assert row.greatest[Kind.LENGTH].value == pytest.approx(0.02, rel=0.3)  # a tenth of the way
    assert row.greatest[Kind.LENGTH].at > 4.0
    assert not check.agrees
    assert check.reason is Reason.OK
