"""Settings that are changed while the robot runs: which, within which bounds, and what is kept of them."""

from pathlib import Path
from types import SimpleNamespace

import pytest

from monstertruck_runtime.clock import run_virtual
from monstertruck_runtime.errors import ConfigError, InputError
from monstertruck_runtime.threads import inline
from monstertruck_schemas.base import live_settings
from monstertruck_schemas.event import Severity
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.roles import AccessRole
from monstertruckd.bus.access import EVERYTHING, Grant, Sender
from monstertruckd.bus.rpc import Rpc
from monstertruckd.config.calibration import CalibrationStore, Estimate, Result
from monstertruckd.config.live import LiveConfig, with_settings
from monstertruckd.config.load import SavedSettings, load_truck
from monstertruckd.config.truck import TruckConfig
from monstertruckd.tools.cli import settings
from tests.unit.gate.rig import Rig

ROOT = Path(__file__).resolve().parents[3]


@pytest.fixture(scope="module")
def plain() -> TruckConfig:
    return load_truck(ROOT / "configs/demo.yaml")[0]


@pytest.fixture
def config(plain: TruckConfig, tmp_path: Path) -> TruckConfig:
    return plain.model_copy(update={"state_directory": tmp_path})


class Robot:
    """The calls of a robot without the rest of it."""

    def __init__(self, config: TruckConfig):
        self.applied: list[TruckConfig] = []
        self.events: list[tuple[Reason, Severity, str]] = []
        self.live = LiveConfig(config, self.applied.append, self._event, inline)

    def _event(self, reason, severity, source, text="", **values):
        self.events.append((reason, severity, text))

    def set(self, values, **more):
        async def main(clock):
            rpc = Rpc(clock)
            self.live.register(rpc)
            return await rpc.call("set", {"values": values, "source": "ann@lab", **more})

        return run_virtual(main)


def test_what_is_live_is_marked_and_says_its_bounds(config: TruckConfig):
    rows = {setting.key: setting for setting in live_settings(config)}
    assert rows["gate.speed"].value == config.gate.speed
    assert (rows["gate.angle"].above, rows["gate.angle"].below) == (0, 1.0)
    assert "gate.tilt.stop" in rows
    assert "gate.rate" not in rows
    assert all(row.meaning for row in rows.values())


@pytest.mark.parametrize(
    ("values", "said"),
    [
        ({"gate.rate": 10.0}, "gate.rate: cannot be changed while the robot runs"),
        ({"gate.speed": 9.0}, "at most"),
        ({"gate.speed": 1e308}, "at most"),
        ({"gate.speed": -1.0}, r"gate\.speed: Input should be greater than 0"),
        ({"gate.speed": "fast"}, r"gate\.speed: Input should be a valid number"),
        ({"gate.reverse_speed": 0.22}, "at most gate.speed"),
        ({"gate.tilt.slow": 0.4}, "hysteresis < slow < stop"),
        ({}, "expected 1 to 32"),
        ({"gate.speed": [1]}, "expected a plain value"),
    ],
)
def test_a_change_that_is_refused_changes_nothing(config: TruckConfig, values, said: str):
    robot = Robot(config)
    with pytest.raises(InputError, match=said):
        robot.set(values, save=True)
    assert (robot.applied, robot.events) == ([], [])
    assert not SavedSettings(config.state_directory, config.robot).path.exists()


def test_a_change_is_applied_as_a_whole_and_said_with_who_made_it(config: TruckConfig):
    robot = Robot(config)
    robot.set({"gate.speed": 0.12, "gate.reverse_speed": 0.1})
    assert robot.applied == [robot.live.config]
    assert (robot.live.config.gate.speed, robot.live.config.gate.reverse_speed) == (0.12, 0.1)
    assert robot.events[0] == (
        Reason.SETTING_CHANGED, Severity.INFO, f"gate.speed: {config.gate.speed} to 0.12 by ann@lab",
    )  # fmt: skip
    assert not SavedSettings(config.state_directory, config.robot).path.exists()


def test_who_makes_the_robot_less_safe_than_by_default_is_warned(
    config: TruckConfig, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    robot = Robot(config)
    assert robot.set({"gate.tilt.stop": 0.3})["weakened"] == []
    client = SimpleNamespace(call=lambda name, payload: robot.set(**payload))
    monkeypatch.setattr(settings, "with_robot", lambda main, *_, **__: main(client, None))
    settings.set_value("gate.tilt.stop", "0.4")
    said = capsys.readouterr()
    assert said.out == "gate.tilt.stop is 0.4 until the daemon ends\n"
    assert "less safe than the default: gate.tilt.stop 0.4, default 0.35" in said.err
    assert robot.set({"gate.speed": 0.1, "gate.reverse_speed": 0.1})["weakened"] == [], "only what is new"


def test_what_is_saved_counts_at_the_next_start_and_names_its_line(tmp_path: Path):
    file = tmp_path / "robot.yaml"
    file.write_text(f"include: {ROOT / 'configs/demo.yaml'}\nversion: 2\nstate_directory: {tmp_path}\n")
    before = load_truck(file)[0]
    robot = Robot(before)
    robot.set({"gate.speed": 0.18})
    robot.set({"gate.tilt.stop": 0.3, "gate.reverse_speed": 0.1}, save=True)
    saved = SavedSettings(before.state_directory, before.robot)
    saved.path.write_text(saved.path.read_text().replace("stop: 0.3", "stop: 0.3  # steep yard"))
    robot.set({"gate.tilt.slow": 0.2}, save=True)
    assert "0.3  # steep yard" in saved.path.read_text()
    after, tree = load_truck(file)
    assert after.gate.speed == before.gate.speed
    assert (after.gate.tilt.stop, after.gate.tilt.slow, after.gate.reverse_speed) == (0.3, 0.2, 0.1)
    assert str(tree.origins["gate", "tilt", "stop"]) == f"{saved.path}:4"


def test_what_is_saved_on_a_calibrated_robot_counts_at_the_next_start(tmp_path: Path):
    """The motor's greatest speed over ground, which bounds gate.speed, follows from a calibrated ratio."""
    file = tmp_path / "robot.yaml"
    file.write_text(f"include: {ROOT / 'configs/demo.yaml'}\nversion: 2\nstate_directory: {tmp_path}\n")
    plain = load_truck(file)[0]
    assert plain.body_limits.motor_speed < 0.221, "without calibration the setting below is refused"
    store = CalibrationStore(plain.calibration_folder, plain.robot)

    def calibrate(ratio: float) -> None:
        estimate = Estimate(name="drive_ratio", value=ratio, samples=4, meaning="test", key="geometry.drive_ratio")
        store.save(Result(wizard="drive", measured="taped", estimates=(estimate,)), 1_795_262_400_000_000_000)

    calibrate(plain.geometry.drive_ratio * 0.99)
    Robot(load_truck(file)[0]).set({"gate.speed": 0.221}, save=True)
    after, tree = load_truck(file)
    assert after.gate.speed == 0.221
    assert after.geometry.drive_ratio == plain.geometry.drive_ratio * 0.99
    assert str(tree.origins["gate", "speed"]) == f"{SavedSettings(plain.state_directory, plain.robot).path}:3"
    assert tree.calibration == store.newest() == tree.origins["geometry", "drive_ratio"].file
    calibrate(plain.geometry.drive_ratio)
    with pytest.raises(ConfigError, match=r"settings-truck\.yaml with .*\.json: gate\.speed 0\.221 m/s: at most"):
        load_truck(file)


def test_what_the_next_start_would_refuse_is_not_saved(config: TruckConfig):
    robot = Robot(with_settings(config, {"gate.speed": 0.15, "gate.reverse_speed": 0.15}))
    robot.set({"gate.reverse_speed": 0.1})
    with pytest.raises(InputError, match=r"reverse_speed 0\.15"):
        robot.set({"gate.speed": 0.12}, save=True)
    assert robot.live.config.gate.speed == 0.15


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("gate:\n  rate: 10\n", r":2: gate\.rate: cannot be changed while the robot runs"),
        ("gate:\n  speed: 9.0\n", "at most"),
        ("gate: [\n", "not valid YAML"),
        ("gate:\n  speed: 0.2\n  speed: 0.1\n", ":3: speed: given twice"),
        ("gate:\n  speed: 2001-99-99\n", ":2: cannot read the value"),
        ("gate:\n  speed: !!bool x\n", ":2: cannot read the value"),
        ("gate: [1, 2]\n", ":1: gate: "),
    ],
)
def test_a_damaged_file_of_saved_settings_is_named(tmp_path: Path, text: str, said: str):
    file = tmp_path / "robot.yaml"
    file.write_text(f"include: {ROOT / 'configs/demo.yaml'}\nversion: 2\nstate_directory: {tmp_path}\n")
    (tmp_path / "settings-truck.yaml").write_text(text)
    with pytest.raises(ConfigError, match=f"settings-truck.yaml.*{said}"):
        load_truck(file)


@pytest.mark.parametrize("text", ["gate: [1, 2]\n", "gate: 0.2\n", "gate:\n  speed: 0.2\n  speed: 0.1\n"])
def test_a_damaged_file_of_saved_settings_is_not_written_over(config: TruckConfig, text: str):
    file = config.state_directory / f"settings-{config.robot}.yaml"
    file.write_text(text)
    with pytest.raises(ConfigError, match=r"settings-truck\.yaml"):
        Robot(config).set({"gate.speed": 0.15}, save=True)
    assert file.read_text() == text


def test_only_an_engineer_sets_and_everybody_may_look(config: TruckConfig):
    async def main(clock):
        rpc = Rpc(clock)
        Robot(config).live.register(rpc)
        observer = Sender("bob", Grant(AccessRole.OBSERVER, EVERYTHING.rank))
        seen, _ = await rpc.answer(observer, "settings", b"")
        for role in AccessRole:
            done, _ = await rpc.answer(
                Sender("bob", Grant(role, EVERYTHING.rank)), "set", b'{"values": {"gate.speed": 0.2}}'
            )
            assert done is (role is AccessRole.ENGINEER), role
        return seen

    assert run_virtual(main)


def test_a_truck_that_drives_slows_down_by_its_ramp_to_a_limit_that_was_lowered():
    rig = Rig().driving(speed=0.2)
    for _ in range(50):
        rig.drive(speed=0.2)
        rig.tick()
    assert rig.out.speeds[0] == pytest.approx(0.2)
    rig.gate.configure(rig.config.model_copy(update={"speed": 0.1, "reverse_speed": 0.1}))
    speeds = []
    for _ in range(25):
        rig.drive(speed=0.2)
        rig.tick()
        speeds.append(rig.out.speeds[0])
    assert speeds[0] == pytest.approx(0.2 - 1.0 / 50), "by its ramp, from the next tick on"
    assert speeds[-1] == pytest.approx(0.1)
    assert Reason.CLIPPED in rig.out.reasons
    assert rig.out.speed_limit == 0.1
