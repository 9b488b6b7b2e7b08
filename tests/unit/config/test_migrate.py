"""Older configuration files become present ones, in steps, with their comments and with a way back."""

import json
from collections.abc import Mapping
from pathlib import Path

import pytest
from pydantic import BaseModel

from monstertruck_estimation.fusion.config import FusionConfig
from monstertruck_runtime.errors import ConfigError, InputError
from monstertruck_runtime.plugins import models_in
from monstertruck_schemas.base import live_settings
from monstertruckd.config.calibration import WizardName, may_set, value_at
from monstertruckd.config.load import SavedSettings, Step, YamlText, load_config, load_tree, load_truck, resolved
from monstertruckd.config.migrate import carry_out, plan
from monstertruckd.config.renamed import RENAMED, present_key
from monstertruckd.config.truck import TruckConfig
from monstertruckd.config.wizards import WIZARDS
from monstertruckd.tools.replay_check.recorded import recorded_config
from tests.unit.config.test_loading import Root

OLD = """# my robot
version: 0   # the first
include: [part.yaml]
bot: rover   # its name
gate:
  lease_ms: 250   # short

# the end
"""
PART = """gate: { lease_ms: 300, rate: 50 }
"""
NEW = """# my robot
version: 2   # the first
include: [part.yaml]
robot: rover   # its name
gate:
  lease: 0.25   # short

# the end
"""


def _to_robot(text: YamlText) -> None:
    text.rename(("bot",), "robot")


def _to_seconds(text: YamlText) -> None:
    milliseconds = text.value("gate", "lease_ms")
    if milliseconds is not None:
        text.replace(("gate", "lease_ms"), f"{int(milliseconds) / 1000:g}")
        text.rename(("gate", "lease_ms"), "lease")


STEPS: Mapping[int, Step] = {0: _to_robot, 1: _to_seconds}


@pytest.fixture
def old(tmp_path: Path) -> Path:
    (tmp_path / "part.yaml").write_text(PART)
    file = tmp_path / "old.yaml"
    file.write_text(OLD)
    file.chmod(0o640)
    return file


def test_a_chain_of_steps_keeps_comments_and_the_previous_files(old: Path):
    upgrades = plan(old, STEPS, 2)
    assert old.read_text() == OLD, "planning writes nothing"
    assert [upgrade.path.name for upgrade in upgrades] == ["part.yaml", "old.yaml"], "what includes comes last"
    carry_out(upgrades)
    assert old.read_text() == NEW
    assert old.stat().st_mode & 0o777 == 0o640
    assert (old.parent / "part.yaml").read_text() == "gate: { lease: 0.3, rate: 50 }\n"
    assert (old.parent / "old.yaml.v0").read_text() == OLD
    assert (old.parent / "part.yaml.v0").read_text() == PART
    assert load_tree(old).data == {"version": 2, "robot": "rover", "gate": {"lease": 0.25, "rate": 50}}
    assert plan(old, STEPS, 2) == [], "nothing is left to do"


def test_an_upgrade_that_broke_off_can_be_repeated(old: Path):
    carry_out(plan(old, STEPS, 2)[:1])
    carry_out(plan(old, STEPS, 2))
    assert old.read_text() == NEW
    assert (old.parent / "part.yaml.v0").read_text() == PART


def test_a_previous_file_of_another_content_is_not_lost(old: Path):
    (old.parent / "old.yaml.v0").write_text("precious")
    with pytest.raises(InputError, match=r"old\.yaml\.v0: already contains another version 0"):
        carry_out(plan(old, STEPS, 2))
    assert old.read_text() == OLD


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("version: 3\n", r"a\.yaml:1: version: 3 is newer than this program, which supports up to 2"),
        ("robot: x\n", r"a\.yaml:1: version: expected 0 to 2, found None"),
        ("\nversion: one\n", r"a\.yaml:2: version: expected 0 to 2, found one"),
        ("version: {\n", r"a\.yaml:2: not valid YAML"),
        ("- version\n", r"a\.yaml:1: expected a mapping"),
        ("version: 0\ninclude: gone.yaml\n", r"gone\.yaml: cannot be read"),
        ("version: 0\ninclude: a.yaml\n", r"a\.yaml: includes itself"),
    ],
)
def test_what_cannot_be_upgraded_is_said(text: str, complaint: str, tmp_path: Path):
    file = tmp_path / "a.yaml"
    file.write_text(text)
    with pytest.raises(ConfigError, match=complaint):
        plan(file, STEPS, 2)


def test_a_hole_in_the_chain_is_said(old: Path):
    with pytest.raises(ConfigError, match="cannot be migrated from version 1 to 2"):
        plan(old, {0: _to_robot}, 2)


def test_a_version_without_a_way_up_is_refused(old: Path):
    for read in (lambda: load_config(old, Root), lambda: plan(old)):
        with pytest.raises(ConfigError, match=r"old\.yaml:2: version: expected 1 to 2, found 0"):
            read()


RELEASE_0_1_0 = """version: 1
robot: rover
include: {base}
planner:
  map: {map}
  deform: {{ kind: rsband }}  # round obstacles
  ladder: [wait, replan]
  "sightings": 4
  local: {{ beside: 0.07, rejoin: 0.02, patience: 3.0 }}
  route: {{ kind: hybrid, greed: 1.5 }}
placement: {{ deformer: loop }}
odometry:
  kind: fusion
  compass: {{ patience: 20.0 }}
usb: {{ patience: 4.0 }}
gate:
  obstacle: {{ beside: 0.03 }}
slam:
  mapper: {{ thinning: 0.2 }}
tracker:
  kind: lqr
  turn_within: 0.06
"""


@pytest.fixture
def release_0_1_0(tmp_path: Path) -> Path:
    """A configuration with every key that has another name since."""
    configs = Path(__file__).resolve().parents[3] / "configs"
    file = tmp_path / "truck.yaml"
    file.write_text(RELEASE_0_1_0.format(base=configs / "truck.yaml", map=configs / "worlds" / "rooms.yaml"))
    return file


def check_0_1_0(config: TruckConfig) -> None:
    planner = config.planner
    assert planner is not None
    assert planner.local_planner is not None
    assert planner.local_planner.kind == "rsband"
    assert (planner.recovery, planner.blocked_scans) == (("wait", "replan"), 4)
    assert (planner.local.rejoin_distance, planner.local.rejoin_clearance) == (0.07, 0.02)
    assert planner.local.blocked_timeout == 3.0
    assert planner.route.heuristic_weight == 1.5
    assert isinstance(config.odometry, FusionConfig)
    assert config.odometry.compass is not None
    assert config.odometry.compass.steady_time == 20.0
    assert config.usb.empty_timeout == 4.0
    assert config.placement.local_planner == "loop"
    assert config.gate.obstacle.side_clearance == 0.03
    assert config.slam is not None
    assert config.slam.mapper.pruning == 0.2
    assert config.tracker is not None
    assert config.tracker.steering_distance == 0.06


def test_a_configuration_of_0_1_0_is_read_as_it_is(release_0_1_0: Path):
    before = release_0_1_0.read_text()
    config, tree = load_truck(release_0_1_0)
    check_0_1_0(config)
    assert str(tree.origin(("planner", "recovery"))) == f"{release_0_1_0}:7"
    assert release_0_1_0.read_text() == before


def test_a_configuration_of_0_1_0_is_migrated(release_0_1_0: Path):
    carry_out(plan(release_0_1_0))
    text = release_0_1_0.read_text()
    assert text.startswith("version: 2\n")
    assert "  local_planner: { kind: rsband }  # round obstacles\n  recovery: [wait, replan]\n" in text
    assert plan(release_0_1_0) == []
    check_0_1_0(load_truck(release_0_1_0)[0])


def test_the_configuration_in_a_log_of_0_1_0_is_read(release_0_1_0: Path):
    values = load_tree(release_0_1_0).data | {"version": 1}
    values["planner"] |= {"ladder": values["planner"].pop("recovery")}
    values["gate"] = {"obstacle": {"beside": 0.03}}
    check_0_1_0(recorded_config(Path("run.mcap"), {"config.json": json.dumps(values).encode()}))


SETTINGS_0_1_0 = """gate:
  speed: 0.2
  reverse_speed: 0.14
  angle: 0.42
  acceleration: 0.4
  yaw_acceleration: 5.0
  steering_rate: 0.9
  tilt: { slow: 0.2, stop: 0.34, slow_speed: 0.07 }
  obstacle:
    ahead: 0.06
    beside: 0.03  # the hedge
    deceleration: 0.14
    unseen_speed: 0.09
"""
"""Settings that may be changed while the robot runs, as 0.1.0 called them."""

CALIBRATION_0_1_0: dict[WizardName, dict[str, float]] = {
    "battery": {"devices.steering.driver.battery.gain": 1.02, "devices.steering.driver.battery.offset": 0.1},
    "compass": {
        f"devices.compass.driver.iron.{name}": value
        for name, value in {"hard_x": 7.5, "hard_y": -3.0, "soft_xx": 1.05, "soft_xy": 0.02, "soft_yy": 0.96}.items()
    },
    "drive": {"geometry.drive_ratio": 640.0, "devices.drive.driver.inverted": True},
    "steering": {
        f"devices.steering.driver.{axle}.{name}": value
        for axle in ("front", "rear")
        for name, value in {
            "centre_us": 1490.0, "scale_us_per_deg": 14.5, "direction": -1, "min_us": 1100.0, "max_us": 1880.0
        }.items()
    },
}  # fmt: skip
"""What the wizards of 0.1.0 measured of a truck with its battery on the servo controller."""


@pytest.fixture
def state(tmp_path: Path) -> Path:
    """State directory of the robot of ``truck.yaml`` next to it."""
    configs = Path(__file__).resolve().parents[3] / "configs"
    state = tmp_path / "state"
    state.mkdir()
    (tmp_path / "truck.yaml").write_text(f"include: {configs}/truck.yaml\nversion: 2\nstate_directory: {state}\n")
    return state


def calibrated_by_0_1_0(state: Path, measured: Mapping[WizardName, Mapping[str, float]]) -> None:
    """Write a file with the fields that 0.1.0 wrote."""
    results = {
        wizard: {
            "wizard": wizard,
            "date": "2026-11-21T16:01:02Z",
            "measured": "taped",
            "estimates": [
                {"name": key, "value": value, "samples": 4, "meaning": "test", "key": key, "date": ""}
                for key, value in values.items()
            ],
        }
        for wizard, values in measured.items()
    }
    head = {"version": 1, "number": 1, "robot": "truck", "written": "2026-11-21T16:01:02Z", "change": "all"}
    (state / "calibration").mkdir()
    (state / "calibration" / "0001-2026-11-21T160102Z.json").write_text(json.dumps(head | {"results": results}))


def test_settings_and_calibration_of_0_1_0_are_read(state: Path):
    saved = SavedSettings(state, "truck")
    saved.path.write_text(SETTINGS_0_1_0)
    calibrated_by_0_1_0(state, CALIBRATION_0_1_0)
    config, tree = load_truck(state.parent / "truck.yaml")
    assert config.gate.obstacle.side_clearance == 0.03
    assert str(tree.origin(("gate", "obstacle", "side_clearance"))) == f"{saved.path}:11"
    values = resolved(config)
    for measured in CALIBRATION_0_1_0.values():
        assert {key: value_at(values, present_key(key)) for key in measured} == measured
    saved.save({"gate.obstacle.ahead": 0.05})
    assert "    side_clearance: 0.03  # the hedge\n" in saved.path.read_text(), "one name, not both"
    assert load_truck(state.parent / "truck.yaml")[0].gate.obstacle.side_clearance == 0.03


def test_files_of_0_1_0_above_name_every_renamed_key_that_may_stand_there(state: Path):
    live = {setting.key for setting in live_settings(load_truck(state.parent / "truck.yaml")[0])}
    assert {old for old in RENAMED[1] if present_key(old) in live} == {"gate.obstacle.beside"}
    assert not [old for old in RENAMED[1] if any(may_set(wizard, present_key(old)) for wizard in WIZARDS)]


def test_a_key_renamed_below_any_name_is_so_in_all_files(state: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(RENAMED[1], "devices.steering.driver.*.middle_us", "centre_us")
    truck = state.parent / "truck.yaml"
    axles = "{front: {middle_us: 1480.0}, 'rear': {'middle_us': 1470.0}}"
    text = truck.read_text().replace("version: 2", "version: 1")
    truck.write_text(f"{text}devices: {{steering: {{driver: {axles}}}}}\n")

    def centres() -> tuple[float, float]:
        steering = load_truck(truck)[0].devices.steering
        assert steering is not None
        return steering.driver.front.centre_us, steering.driver.rear.centre_us

    assert centres() == (1480.0, 1470.0)
    carry_out(plan(truck))
    assert "{front: {centre_us: 1480.0}, 'rear': {\"centre_us\": 1470.0}}" in truck.read_text()
    calibrated_by_0_1_0(state, {"steering": {"devices.steering.driver.rear.middle_us": 1450.0}})
    assert centres() == (1480.0, 1450.0)


@pytest.mark.parametrize(("old", "name"), [row for rows in RENAMED.values() for row in rows.items()])
def test_a_renamed_key_is_there_and_its_old_name_is_nobody_elses(old: str, name: str):
    *way, last = old.split(".")
    models: list[type[BaseModel]] = [TruckConfig]
    for part in way:
        if part != "*":  # the models of a mapping by name are those of its values
            fields = [model.model_fields[part] for model in models if part in model.model_fields]
            models = [model for field in fields for model in models_in(field)]
    known = {field for model in models for field in model.model_fields}
    assert name in known
    assert last not in known


def test_edits_touch_nothing_else():
    text = YamlText('a:   # one\n  - b: 1\n  - c\n\n# two\nd: "x" # three\n', Path("x.yaml"))
    assert (text.value("d"), text.value("a"), text.value("d", "e")) == ("x", None, None)
    assert text.replace(("a",), "[]")
    assert text.text == 'a:   # one\n  []\n\n# two\nd: "x" # three\n'
    assert text.replace(("d",), "y")
    assert not text.rename(("e",), "f")
    assert not text.replace(("d", "e"), "1")
    assert text.text == "a:   # one\n  []\n\n# two\nd: y # three\n"
