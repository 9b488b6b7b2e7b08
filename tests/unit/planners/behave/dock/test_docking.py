"""Docking and undocking of a robot in the plane: how accurate, and what it does when a dock is not as expected."""

import math

import numpy as np
import pytest

from monstertruck_planners.behave.dock.config import DockConfig, DockingConfig, chosen
from monstertruck_planners.behave.dock.docking import STEERING_LENGTH, Dock, curvature, predicted
from monstertruck_planners.behave.dock.estimate import driven, seen, staging_pose
from monstertruck_schemas.points import TagPose
from monstertruck_schemas.reasons import Reason
from tests.unit.planners.behave.dock.kit import Robot

FORWARD = DockConfig(x=2.0, y=1.0, yaw=0.5, tag=7)
REVERSE = FORWARD.model_copy(update={"direction": "reverse", "yaw": 0.5 - math.pi})


def staged(dock: DockConfig, seed: int = 0, **more) -> Robot:
    """A robot at the staging pose, within the tolerance of a goal."""
    off = np.random.default_rng(seed + 1000).uniform(-1, 1, 3) * (0.05, 0.05, 0.1)
    return Robot(dock, np.array(staging_pose(dock)) + off, seed, **more)


@pytest.mark.parametrize("seed", range(3))
def test_it_docks_forward_within_a_centimetre_and_a_degree(seed: int):
    robot = staged(FORWARD, seed)
    step = robot.docks()
    assert step.outcome is Reason.BEHAVIOUR_DONE, step.text
    assert robot.error[0] < 0.01
    assert robot.error[1] < math.radians(1.0)
    assert robot.phases[:4] == ["perceive", "approach", "settle", "charge"]
    ahead = (np.array(robot.trail)[:, :2] - (2.0, 1.0)) @ (math.cos(0.5), math.sin(0.5))
    assert ahead.max() < 0.005, "drove past the dock"


@pytest.mark.parametrize("seed", range(2))
def test_it_turns_its_rear_to_the_dock_after_a_look_at_the_tag(seed: int):
    robot = staged(REVERSE, seed)
    step = robot.docks()
    assert step.outcome is Reason.BEHAVIOUR_DONE, step.text
    assert robot.error[0] < 0.01
    assert robot.error[1] < math.radians(1.0)
    assert robot.phases[:6] == ["perceive", "look", "view", "back_off", "turn_out", "turn_in"]


def test_many_images_from_one_place_do_not_outweigh_those_of_the_way():
    def image(yaw: float) -> TagPose:
        return TagPose(tag=7, x=0.6, y=0.0, z=0.2, yaw=yaw, covariance=np.diag((1e-6, 1e-6, 4e-6)).ravel())

    base, estimate = np.zeros(3), None
    for _ in range(10):
        estimate = seen(estimate, image(0.0), base)
        estimate = driven(estimate, base, 0.06)
    for _ in range(100):
        estimate = seen(estimate, image(0.014), base)
    assert abs(estimate.mean[2]) < 0.007
    assert estimate.deviation > 0.002


def test_without_a_tag_it_does_not_move():
    robot = staged(FORWARD, hidden=True)
    step = robot.docks()
    assert (step.outcome, len(robot.phases)) == (Reason.DOCK_NOT_SEEN, 1)
    assert np.ptp(np.array(robot.trail)[:, :2], axis=0).max() == 0.0
    assert "tag 7 of dock charger" in step.text


def test_a_dock_that_does_not_charge_is_tried_three_times():
    robot = staged(FORWARD, charger=0.0)
    step = robot.docks()
    assert step.outcome is Reason.NOT_CHARGING
    assert "attempt 3" in step.text
    assert robot.phases.count("approach") == 3
    assert robot.phases.count("retreat") == 2


def test_charging_shows_in_the_voltage_of_a_robot_that_does_not_measure_the_current():
    robot = staged(FORWARD, sensor=False)

    def charged(step) -> bool:
        return step.outcome is Reason.BEHAVIOUR_DONE

    step = robot.docks(attempts=1)
    assert not charged(step), "the voltage was high on arrival already"
    late = staged(FORWARD, sensor=False, charger=0.0)
    inputs = late.inputs

    def rising():
        late.charger = 3.0 if late.phases[-1:] == ["charge"] else 0.0
        return inputs()

    late.inputs = rising
    assert charged(late.docks())


def test_a_robot_that_would_miss_the_dock_tries_again():
    robot = staged(FORWARD, 1)
    move, pushed = robot.move, []

    def shoved(vx: float, wz: float) -> None:
        if robot.phases[-1:] == ["approach"] and robot.error[0] < 0.2 and not pushed:
            pushed.append(True)
            robot.pose = robot.pose + np.array((-math.sin(0.5), math.cos(0.5), 0.0)) * 0.06
        move(vx, wz)

    robot.move = shoved
    step = robot.docks()
    assert step.outcome is Reason.BEHAVIOUR_DONE, step.text
    assert "retreat" in robot.phases
    assert robot.error[0] < 0.01


def test_a_tag_that_is_hidden_on_the_way_ends_with_the_reason_at_rest():
    robot = staged(FORWARD)
    move = robot.move

    def hide(vx: float, wz: float) -> None:
        robot.hidden |= robot.error[0] < 0.4
        move(vx, wz)

    robot.move = hide
    step = robot.docks()
    assert step.outcome is Reason.DOCK_NOT_SEEN, step.text
    assert step.motion is None
    assert "was not seen within 6 s" in step.text
    assert robot.error[0] > 0.2, "it went on without the tag"


def test_a_dock_that_is_moved_meanwhile_is_found_again():
    robot = staged(FORWARD, 2)
    move, moved = robot.move, []

    def shift(vx: float, wz: float) -> None:
        if robot.error[0] < 0.3 and not moved:
            moved.append(True)
            robot.dock = FORWARD.model_copy(update={"x": 2.04, "y": 1.05})
        move(vx, wz)

    robot.move = shift
    step = robot.docks()
    assert step.outcome is Reason.BEHAVIOUR_DONE, step.text
    assert robot.phases.count("retreat") == 1
    assert robot.error[0] < 0.01


@pytest.mark.parametrize("dock", [FORWARD, REVERSE])
def test_it_undocks_to_the_staging_distance_and_only_from_a_dock(dock: DockConfig):
    robot = Robot(dock, np.array((dock.x, dock.y, dock.yaw)))
    step = robot.undocks()
    assert step.outcome is Reason.BEHAVIOUR_DONE
    assert robot.error[0] == pytest.approx(dock.staging, abs=0.03)
    assert math.dist(robot.pose[:2], staging_pose(dock)[:2]) < 0.03
    assert robot.undocks().outcome is Reason.DOCK_MISSED
    turned = Robot(dock, np.array((dock.x, dock.y, dock.yaw + 0.4)))
    assert turned.undocks().outcome is Reason.DOCK_MISSED
    lost = Robot(dock, np.array((dock.x, dock.y, dock.yaw)))
    lost.located = False
    assert lost.undocks().outcome is Reason.INPUT_STALE


def test_a_dock_is_chosen_by_its_name():
    docks = {"a": FORWARD, "b": REVERSE}
    assert chosen(docks, "b") == ("b", REVERSE)
    assert chosen({"a": FORWARD}, "") == ("a", FORWARD)
    with pytest.raises(ValueError, match="expected one of a, b"):
        chosen(docks, "")
    with pytest.raises(ValueError, match="no section `docks`"):
        Dock(DockingConfig(), Robot(FORWARD, np.zeros(3)).body)


@pytest.mark.parametrize("way", [1, -1])
def test_the_steering_leads_onto_the_axis_either_way_as_predicted(way: int):
    across, turn, step = 0.03, 0.05, 0.002
    foreseen = predicted(across, way * turn, 0.3)
    for _ in range(150):
        turn += curvature(across, turn, way, 10.0) * step
        across += way * math.sin(turn) * step
    assert across == pytest.approx(foreseen, abs=0.003)
    assert abs(across) < 0.03 * (1 + 0.3 / STEERING_LENGTH) * math.exp(-0.3 / STEERING_LENGTH) + 0.006
