"""Older configuration files become present ones, in steps, with their comments and with a way back."""

import json
from collections.abc import Mapping
from pathlib import Path

import pytest

from monstertruck_estimation.fusion.config import FusionConfig
from monstertruck_runtime.errors import ConfigError, InputError
from monstertruckd.config.load import Step, YamlText, load_config, load_tree, load_truck
from monstertruckd.config.migrate import carry_out, plan
from monstertruckd.config.truck import TruckConfig
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
    with pytest.raises(InputError, match=r"old\.yaml\.v0: holds another version 0"):
        carry_out(plan(old, STEPS, 2))
    assert old.read_text() == OLD


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("version: 3\n", r"a\.yaml:1: version: 3 is newer than this program, which knows up to 2"),
        ("robot: x\n", r"a\.yaml:1: version: expected a number of 0 to 2, found None"),
        ("\nversion: one\n", r"a\.yaml:2: version: expected a number of 0 to 2, found 'one'"),
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
    with pytest.raises(ConfigError, match="no way from version 1 to 2"):
        plan(old, {0: _to_robot}, 2)


def test_a_version_without_a_way_up_is_refused(old: Path):
    with pytest.raises(ConfigError, match=r"old\.yaml:2: version: expected 1 to 2, found 0"):
        load_config(old, Root)


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


def test_edits_touch_nothing_else():
    text = YamlText('a:   # one\n  - b: 1\n  - c\n\n# two\nd: "x" # three\n', Path("x.yaml"))
    assert (text.value("d"), text.value("a"), text.value("d", "e")) == ("x", None, None)
    assert text.replace(("a",), "[]")
    assert text.text == 'a:   # one\n  []\n\n# two\nd: "x" # three\n'
    assert text.replace(("d",), "y")
    assert not text.rename(("e",), "f")
    assert not text.replace(("d", "e"), "1")
    assert text.text == "a:   # one\n  []\n\n# two\nd: y # three\n"
