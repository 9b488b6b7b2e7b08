"""The dock check: it lets the robot come near a dock that a behaviour approaches, slowly, and nothing else."""

import math

import pytest

from monstertruck_planners.behave.dock.config import DockConfig, HousingConfig
from monstertruck_runtime.clock import SECOND
from monstertruck_schemas import topics
from monstertruck_schemas.base import Pose2D, Twist2D
from monstertruck_schemas.plan import BehaviourState, DockTarget
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import Role
from monstertruck_schemas.state import Odometry
from monstertruckd.gate.docking import DockCheck
from monstertruckd.gate.obstacles import ObstacleCheck
from tests.unit.gate.rig import ANY_GROUND, TICK, Rig, check_of, header, make_gate, scan

HOUSING = HousingConfig(width=0.3, depth=0.2)
FACE = 1.0 + 0.47 / 2
"""x of the housing, which the docked robot touches (m)."""
PLANNER = {"role": Role.TRACKER, "source": "behaviours", "inside": True}


class Docking(Rig):
    """A truck that drives along x to a dock whose docked pose is x = 1."""

    def __init__(self, way=1, obstacle=ANY_GROUND, **dock):
        super().__init__(obstacle=obstacle)
        yaw = 0.0 if way > 0 else math.pi
        dock = {"x": 1.0, "y": 0.0, "yaw": yaw, "tag": 1, "housing": HOUSING, "staging": 0.6} | dock
        if way < 0:
            dock["direction"] = "reverse"
        self.gate = make_gate(docks={"charger": DockConfig(**dock)}, obstacle=obstacle)
        self.place, self.yaw, self.way = [0.5, 0.0], yaw, way
        self.reported, self.located = 1.0, True
        self.dock, self.things = "charger", ()
        self.late = 0
        """Age of a scan on arrival (ns)."""

    def sense(self):
        self.place[0] += self.speed * 0.02 * self.way
        c = self.way
        self.obstacles = [(c * (x - self.place[0]), c * (y - self.place[1])) for x, y in self.things]
        self.silent = {"scan"}
        super().sense()
        seen = scan(self.now, *self.obstacles).model_copy(update={"stamp": self.now - self.late})
        self.gate.observe(seen, topics.SCAN)
        odometry = Odometry(
            **header(self.now), frame="odom", pose=Pose2D(x=self.place[0], y=self.place[1], yaw=self.yaw),
            twist=Twist2D(vx=self.speed, vy=0.0, wz=0.0), pose_covariance=(0.0,) * 9, twist_covariance=(0.0,) * 9,
            age=0.0,
        )  # fmt: skip
        self.gate.observe(odometry, topics.ODOMETRY)
        if self.located:
            self.gate.observe(odometry.model_copy(update={"frame": "map"}), topics.POSE)
        target = None if self.dock is None else DockTarget(name=self.dock, pose=Pose2D(x=self.reported, y=0.0, yaw=0.0))
        state = BehaviourState(**header(self.now), frame="odom", running=True, kind="dock", dock=target)
        self.gate.observe(state, topics.BEHAVIOUR)


HOUSE = tuple((FACE, y / 100) for y in range(-14, 15))


def end(rig) -> float:
    return rig.place[0] + 0.47 / 2


def test_a_docking_truck_touches_the_housing_slowly_and_goes_no_farther():
    rig = Docking()
    rig.things = HOUSE
    rig.driving(speed=0.2, **PLANNER)
    assert rig.speed == pytest.approx(0.05)
    assert Reason.DOCKING in rig.out.reasons
    rig.tick(600)
    assert FACE - 0.005 < end(rig) < FACE + 0.03
    assert rig.speed == 0.0
    assert Reason.OBSTACLE_STOP in rig.out.reasons


@pytest.mark.parametrize(
    ("change", "driver"),
    [
        ({"dock": None}, PLANNER),
        ({"dock": "other"}, PLANNER),
        ({"place": [0.5, 0.2]}, PLANNER),
        ({"yaw": 0.4}, PLANNER),
        ({"reported": 1.31}, PLANNER),
        ({"located": False}, PLANNER),
        ({"things": ((FACE, 0.0), (FACE - 0.1, 0.05))}, PLANNER),
        ({}, {"source": "ann"}),
    ],
)
def test_without_docking_off_the_axis_or_for_a_person_it_is_an_obstacle(change, driver):
    rig = Docking()
    rig.things = HOUSE
    for name, value in change.items():
        setattr(rig, name, value)
    rig.driving(speed=0.2, **driver)
    rig.tick(600)
    assert rig.speed == 0.0
    assert end(rig) < FACE - 0.04


def test_a_truck_reverses_into_a_dock_over_ground_that_no_sensor_has_seen():
    usual = Docking(way=-1, obstacle={"unseen_speed": 1.0})
    usual.dock = None
    usual.armed()
    usual.driver = {"speed": -0.1, **PLANNER}
    usual.tick(100)
    assert Reason.UNSEEN_STOP in usual.out.reasons
    rig = Docking(way=-1, obstacle={"unseen_speed": 1.0})
    rig.armed()
    rig.driver = {"speed": -0.1, **PLANNER}
    rig.tick(100)
    assert rig.speed == pytest.approx(-0.05)


def test_unseen_ground_is_allowed_on_the_axis_only():
    rig = Docking(way=-1, obstacle={"unseen_speed": 1.0})
    rig.place = [0.5, 0.14]
    rig.armed()
    rig.driver = {"speed": -0.1, **PLANNER}
    rig.tick(40)
    assert rig.speed == pytest.approx(-0.05)
    guard = check_of(rig.gate, ObstacleCheck).guard
    assert guard.known == math.inf
    rig.driver = {"speed": -0.1, "front": -0.3, "rear": 0.3, **PLANNER}
    rig.tick(40)
    assert guard.known < 0.2


def test_a_truck_reaches_the_docked_pose_in_reverse():
    rig = Docking(way=-1, obstacle={"unseen_speed": 1.0})
    rig.place = [0.9, 0.0]
    rig.armed()
    rig.driver = {"speed": -0.1, **PLANNER}
    rig.tick(200)
    assert 1.015 < rig.place[0] < 1.03
    assert rig.speed == 0.0


def test_the_dock_is_where_the_scan_has_seen_it():
    rig = Docking()
    rig.late = 4 * TICK
    rig.driving(speed=0.2, ticks=80, **PLANNER)
    area = check_of(rig.gate, DockCheck).view.dock
    assert rig.speed == pytest.approx(0.05)
    assert area.docked[0] == pytest.approx(1.0 - rig.place[0] + 4 * 0.02 * 0.05)


def near(rig, ticks=3):
    """Whether the gate takes the robot for near its dock."""
    rig.armed()
    rig.driver = {"speed": 0.05 * rig.way, **PLANNER}
    rig.tick(ticks)
    return check_of(rig.gate, DockCheck).view.dock is not None


@pytest.mark.parametrize(
    ("change", "inside"),
    [
        ({"place": [0.26, 0.0]}, True),
        ({"place": [0.24, 0.0]}, False),
        ({"place": [1.015, 0.0]}, True),
        ({"place": [1.025, 0.0]}, False),
        *(({"place": [0.5, side * 0.145]}, True) for side in (1, -1)),
        *(({"place": [0.5, side * 0.155]}, False) for side in (1, -1)),
        *(({"yaw": side * 0.29}, True) for side in (1, -1)),
        *(({"yaw": side * 0.31}, False) for side in (1, -1)),
        *(({"place": [0.6, 0.0], "reported": 1.0 + side * 0.29}, True) for side in (1, -1)),
        *(({"place": [0.6, 0.0], "reported": 1.0 + side * 0.31}, False) for side in (1, -1)),
    ],
)
def test_the_robot_is_near_its_dock_within_these_bounds(change, inside):
    rig = Docking()
    for name, value in change.items():
        setattr(rig, name, value)
    assert near(rig) is inside


@pytest.mark.parametrize(
    ("place", "yaw", "inside"),
    [(0.26 - 0.4, math.pi, True), (0.24 - 0.4, math.pi, False), (0.5, 0.0, True), (0.5, 0.31, False), (0.5, 2.9, True)],
)
def test_a_robot_that_docks_in_reverse_may_turn_about_beyond_staging(place, yaw, inside):
    rig = Docking(way=-1, turning=0.4)
    rig.place, rig.yaw = [place, 0.0], yaw
    assert near(rig) is inside


@pytest.mark.parametrize("topic", [topics.BEHAVIOUR, topics.ODOMETRY, topics.POSE])
@pytest.mark.parametrize("old", [False, True])
def test_a_report_odometry_or_pose_that_is_old_shows_no_dock(topic, old):
    rig = Docking()
    assert near(rig)
    limit = 1.0 if topic is topics.BEHAVIOUR else topic.fresh_for()
    age, observe = round((limit + (0.05 if old else -0.05)) * SECOND), rig.gate.observe

    def aged(message, of):
        observe(message.model_copy(update={"received": message.received - age}) if of is topic else message, of)

    rig.gate.observe = aged
    rig.tick(2)
    assert (check_of(rig.gate, DockCheck).view.dock is None) is old


def test_a_behaviour_that_has_ended_or_another_planner_shows_no_dock():
    rig = Docking()
    assert near(rig)
    rig.driver = {"speed": 0.05, **PLANNER, "source": "tracker"}
    rig.tick(50)
    assert check_of(rig.gate, DockCheck).view.dock is None
