"""The zone check: it stops before and inside keepout zones, slows on speed zones, and stands without a pose."""

import math

import numpy as np
import pytest

from monstertruck_planners.zones.config import ZonesConfig
from monstertruck_planners.zones.shapes import mask_of
from monstertruck_runtime.clock import SECOND
from monstertruck_schemas import topics
from monstertruck_schemas.base import Pose2D, Twist2D
from monstertruck_schemas.health import LocalisationStatus, SlamHealth
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import Order
from monstertruck_schemas.state import GateMode, Odometry
from monstertruck_schemas.zones import Zone
from monstertruckd.gate.zones import ZoneCheck, entry_speed
from tests.unit.gate.rig import ANY_GROUND, Rig, check_of, header, make_gate
from tests.unit.planners.zones.zone_kit import zone, zones


class Zoned(Rig):
    """A truck that knows its place, and zones around it; it drives along x."""

    def __init__(self, *which, margin=0.05, **config):
        super().__init__(obstacle=ANY_GROUND, **config)
        self.gate = make_gate(zones=ZonesConfig(margin=margin), obstacle=ANY_GROUND, **config)
        self.which, self.place, self.moving = which, (1.2, 0.0, 0.0), True
        self.old = 0

    def sense(self):
        super().sense()
        if self.moving:
            x, y, yaw = self.place
            self.place = (x + self.speed * 0.02 * math.cos(yaw), y + self.speed * 0.02 * math.sin(yaw), yaw)
        if self.place is not None and not self.old:
            x, y, yaw = self.place
            odometry = Odometry(
                **header(self.now), frame="map", pose=Pose2D(x=x, y=y, yaw=yaw), twist=Twist2D(vx=0.0, vy=0.0, wz=0.0),
                pose_covariance=(0.0,) * 9, twist_covariance=(0.0,) * 9, age=0.0,
            )  # fmt: skip
            self.gate.observe(odometry, topics.POSE)
        if self.which is not None:
            self.gate.observe(zones(*self.which), topics.ZONES)


def front(rig):
    return rig.place[0] + 0.47 / 2


def test_the_truck_stops_before_a_keepout_zone_and_may_drive_away():
    rig = Zoned(zone()).driving(speed=0.2)
    rig.tick(250)
    assert 1.8 < front(rig) < 2.0 - 0.05
    assert (rig.out.speeds[0], rig.out.reasons) == (0.0, (Reason.KEEPOUT,))
    assert rig.out.mode is GateMode.DRIVING
    assert "a keepout zone is ahead" in rig.trips[-1].text
    (distance,) = [m for m in rig.trips[-1].causes[0].measurements if m.name == "distance to the zone"]
    assert 0.0 < distance.value < 0.3
    rig.driver = {"speed": -0.1}
    rig.tick(60)
    assert front(rig) < 1.85


def test_a_turn_at_a_zone_keeps_the_corners_out():
    rig = Zoned(zone(corners=((-1.0, 0.24), (1.0, 0.24), (1.0, 1.0), (-1.0, 1.0))))
    rig.place = (0.0, 0.0, 0.0)
    rig.moving = False
    rig.driving(speed=0.2, front=0.3, rear=-0.3)
    assert Reason.KEEPOUT in rig.out.reasons
    rig.driver = {"speed": 0.2, "front": 0.0, "rear": 0.0}
    rig.tick(60)
    assert rig.out.speeds[0] == pytest.approx(0.2)


@pytest.mark.parametrize("place", [(2.5, 0.0, 0.3), (1.8, 0.0, 0.0)])
def test_a_pose_that_jumps_into_a_zone_stops_the_truck_and_going_on_takes_turning_it_off(place):
    rig = Zoned(zone()).driving(speed=0.2)
    rig.place = place
    rig.tick()
    assert rig.out.mode is GateMode.STOPPING
    rig.tick(100)
    assert rig.speed == 0.0
    assert (
        "in the keepout zone stairs: switch it off (`monstertruckd zone off stairs`) to drive out" in rig.trips[-1].text
    )
    assert rig.reported(Reason.KEEPOUT)
    rig.driver = None
    rig.order(Order.DISARM)
    rig.tick(100)
    assert rig.decide(Order.ARM).reason is Reason.KEEPOUT
    rig.which = (zone(off_until=rig.now + SECOND),)
    rig.tick()
    rig.driving(ticks=20, speed=-0.1)
    assert rig.speed < 0
    rig.place, rig.moving = place, False
    rig.tick(40)
    assert rig.speed == 0.0, "its time off is over, whatever the zone service says"
    assert Reason.KEEPOUT in rig.out.reasons


def test_a_zone_to_be_left_is_left_slowly_and_not_entered_again():
    rig = Zoned(zone(inside="leave"))
    rig.place = (3.1, 0.0, 0.0)
    rig.driving(speed=0.2)
    assert rig.out.speeds[0] == pytest.approx(0.1)
    assert Reason.KEEPOUT in rig.out.reasons
    rig.tick(150)
    assert rig.place[0] > 3.3
    assert rig.out.speeds[0] == pytest.approx(0.2)
    rig.driver = {"speed": -0.2}
    rig.tick(150)
    assert rig.place[0] - 0.47 / 2 > 3.05


def test_another_zone_is_a_wall_for_a_robot_that_leaves_one():
    rig = Zoned(zone(inside="leave"), zone("wall", ((3.0, -1.0), (4.0, -1.0), (4.0, 1.0), (3.0, 1.0))))
    rig.place = (2.5, 0.0, 0.0)
    rig.driving(speed=0.2)
    rig.tick(200)
    assert front(rig) < 3.0


@pytest.mark.parametrize("masked", [False, True])
def test_the_truck_is_slow_from_where_it_reaches_a_speed_zone_to_where_it_has_left_it(masked):
    slow = zone("yard", ((2.0, -0.5), (2.2, -0.5), (2.2, 0.5), (2.0, 0.5)), kind="speed", limit=0.12)
    if masked:
        slow = Zone(name="yard", kind="speed", mask=mask_of(np.full((10, 2), 0.12), 0.1, (2.0, -0.5)))
    rig = Zoned(slow)
    speeds = []
    rig.driving(ticks=1, speed=0.2)
    for _ in range(170):
        rig.tick(3)
        speeds.append((front(rig), rig.speed, rig.out.reasons))
    inside = [speed for at, speed, _ in speeds if 2.0 < at < 2.2 + 0.47]
    assert max(inside) <= 0.12 + 1e-9
    assert max(speed for at, speed, _ in speeds if at < 1.7) == pytest.approx(0.2)
    assert speeds[-1][1] == pytest.approx(0.2), "behind it"
    assert {reason for at, _, reasons in speeds if 2.1 < at < 2.6 for reason in reasons} == {Reason.ZONE_SLOW}


def test_a_robot_that_does_not_know_its_place_or_its_zones_stands():
    rig = Zoned()
    rig.which = None
    rig.armed()
    rig.driver = {"speed": 0.2}
    rig.tick(10)
    assert (rig.speed, rig.out.reasons) == (0.0, (Reason.KEEPOUT,))
    assert "not known yet" in check_of(rig.gate, ZoneCheck).text(Reason.KEEPOUT)
    rig.which = ()
    rig.tick(20)
    assert rig.speed > 0, "no zones: nothing to keep"
    rig.which, rig.old = (zone(),), 1
    rig.tick(40)
    assert (rig.speed, rig.out.reasons) == (0.0, (Reason.KEEPOUT,))
    assert "no fresh pose" in check_of(rig.gate, ZoneCheck).text(Reason.KEEPOUT)
    rig.driver = {"speed": 0.2, "unseen": True}
    rig.tick(40)
    assert 0 < rig.speed <= rig.config.obstacle.confirmed_speed + 1e-9, "an operator with the second control"
    rig.old = 0
    rig.driver = {"speed": 0.2}
    nowhere = SlamHealth(
        **header(rig.now), standing=LocalisationStatus.SEARCHING, accepted=False, overlap=0.0, residual=0.0,
        degeneracy=1.0, direction=0.0,
    )  # fmt: skip
    rig.gate.observe(nowhere, topics.SLAM)
    rig.tick(40)
    assert rig.speed == 0.0
    assert "its pose on the saved map is unknown" in check_of(rig.gate, ZoneCheck).text(Reason.KEEPOUT)


def test_the_speed_before_a_limit_is_one_from_which_it_is_reached_in_time():
    assert entry_speed(0.0, 0.2, 0.5, 0.1) == 0.1
    for room in (0.05, 0.3, 2.0):
        speed = entry_speed(room, 0.2, 0.5, 0.1)
        assert speed * 0.2 + (speed**2 - 0.1**2) / (2 * 0.5) <= room + 1e-9 or speed == 0.1
    assert entry_speed(2.0, 0.2, 0.5, 0.1) > 1.2
