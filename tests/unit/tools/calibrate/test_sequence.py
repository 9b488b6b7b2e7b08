"""Which calibrations are still to be done, in which order."""

from pathlib import Path

from typer.testing import CliRunner

from monstertruckd.config.calibration import Estimate, Result
from monstertruckd.config.load import load_config
from monstertruckd.config.truck import TruckConfig
from monstertruckd.config.wizards import sequence
from monstertruckd.tools.calibrate.steps import Number
from monstertruckd.tools.calibrate.wizard import missing
from monstertruckd.tools.cli import calibrate

ORDER = list(sequence())
CONFIGS = Path(__file__).resolve().parents[4] / "configs"
TRUCK = load_config(CONFIGS / "truck.yaml", TruckConfig)[0]


def result(wizard, *names):
    estimates = tuple(Estimate(name=name, value=1.0, samples=1, meaning="test") for name in names)
    return Result(wizard=wizard, measured="test", estimates=estimates)


def names(steps):
    return [step.name for step in steps]


def test_a_truck_needs_everything_it_has_in_order():
    assert names(missing(TRUCK, {})) == [
        "battery", "drive", "steering", "compass", "drive", "steering", "odometry", "stabiliser", "lidar",
        "camera",
    ]  # fmt: skip


def test_a_skid_steer_robot_on_a_stand_needs_its_slip_alone():
    stand = load_config(CONFIGS / "robots" / "skid_stand.yaml", TruckConfig)[0]
    assert names(missing(stand, {})) == ["slip"]


def test_a_robot_with_sonars_needs_their_places():
    robot = load_config(CONFIGS / "robots" / "sonar.yaml", TruckConfig)[0]
    assert names(missing(robot, {})) == ["sonar"]


def test_what_is_fresh_is_skipped_and_a_first_look_is_taken_once():
    results = {"battery": result("battery", "gain"), "drive": result("drive", "inverted")}
    left = missing(TRUCK, results)
    assert names(left) == ["steering", "compass", "drive", "steering", "odometry", "stabiliser", "lidar", "camera"]
    assert [run.step.rough for run in left[:1]] == [True]
    results["drive"] = result("drive", "inverted", "drive_ratio")
    assert "drive" not in names(missing(TRUCK, results))


def test_a_lidar_that_no_stabiliser_levels_is_measured_with_the_heights_of_its_beam():
    (levelled,) = [step for step in missing(TRUCK, {}) if step.name == "lidar"]
    assert not calibrate.wizard_of(levelled).heights
    plain = TRUCK.model_copy(update={"devices": TRUCK.devices.model_copy(update={"stabiliser": None})})
    for results in ({}, {"lidar": result("lidar", "x")}):
        (step,) = [step for step in missing(plain, results) if step.name == "lidar"]
        wizard = calibrate.wizard_of(step)
        assert wizard.heights
        assert "a wall straight ahead" in wizard.room
    assert "lidar" not in names(missing(plain, {"lidar": result("lidar", "x", "pitch", "roll")}))
    blind = plain.model_copy(update={"devices": plain.devices.model_copy(update={"compass": None})})
    assert "lidar" not in names(missing(blind, {})), "its wizard needs a compass"


def test_answers_given_beforehand_are_taken_in_the_order_of_asking_over_all_wizards(monkeypatch):
    steps, heard = [step for step in ORDER if step.name in ("odometry", "stabiliser")], []

    async def left(call, clock):
        return steps[len(heard) :], False

    async def run(wizard, call, clock, panel):
        heard.append((wizard.name, await panel.number(Number("ahead", "How far ahead?", -50.0, 50.0))))
        return result(wizard.name, "x"), "file"

    monkeypatch.setattr(calibrate, "_steps_left", left)
    monkeypatch.setattr(calibrate, "_run_wizard", run)
    done = CliRunner().invoke(calibrate.app, ["all", "-a", "ahead=2", "-a", "ahead=23", "-a", "left=1"])
    assert done.exit_code == 0, done.output
    assert heard == [("odometry", 2.0), ("stabiliser", 23.0)]
    assert done.stderr.count("did not ask for it") == 1
    assert "--answer left=1: the wizard did not ask for it" in done.stderr


def test_what_has_expired_is_measured_again_without_a_first_look():
    results = {run.name: result(run.name, "inverted", "front_centre", run.step.complete) for run in ORDER}
    assert missing(TRUCK, results) == []
    (again,) = missing(TRUCK, results, {"drive"})
    assert (again.name, again.step.rough) == ("drive", False)


def test_every_step_has_its_wizard():
    assert [calibrate.wizard_of(step).name for step in ORDER] == [step.name for step in ORDER]
