"""Which calibrations are still to be done, in which order."""

from pathlib import Path

from monstertruckd.config.calibration import Estimate, Result
from monstertruckd.config.load import load_config
from monstertruckd.config.truck import TruckConfig
from monstertruckd.tools.calibrate.sequence import ORDER, missing
from monstertruckd.tools.cli import calibrate

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
    assert [step.rough for step in left[:1]] == [True]
    results["drive"] = result("drive", "inverted", "drive_ratio")
    assert "drive" not in names(missing(TRUCK, results))


def test_what_has_expired_is_measured_again_without_a_first_look():
    results = {step.name: result(step.name, "inverted", "front_centre", step.complete) for step in ORDER}
    assert missing(TRUCK, results) == []
    (again,) = missing(TRUCK, results, {"drive"})
    assert (again.name, again.rough) == ("drive", False)


def test_every_step_has_its_wizard():
    assert [calibrate.wizard_of(step).name for step in ORDER] == [step.name for step in ORDER]
