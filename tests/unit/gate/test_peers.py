"""Other robots by what they say of themselves: behind the robot they stop it, before the lidar they do not count."""

from math import inf, pi

import numpy as np
import pytest

from monstertruck_planners.collision import Footprint
from monstertruck_runtime.clock import SECOND
from monstertruck_schemas.base import Pose2D, Twist2D
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.state import Odometry, Peer, Peers
from monstertruckd.gate.config import GateConfig
from monstertruckd.gate.peers import PeerGuard
from tests.unit.gate.rig import ANY_GROUND, Rig, make_gate

AHEAD, BACK, SPOT = (1.0, 0.0, 0.0), (-1.0, 0.0, 0.0), (0.0, 0.0, 4.0)
BODY = Footprint(0.48, 0.34, padding=0.0)
HEARD = 100 * SECOND


def blind(points):
    return np.zeros(len(points), bool)


def pose(x=0.0, y=0.0, yaw=0.0):
    return Odometry(
        stamp=0, received=0, seq=0, frame="map", pose=Pose2D(x=x, y=y, yaw=yaw), twist=Twist2D(vx=0.0, vy=0.0, wz=0.0),
        pose_covariance=np.zeros(9), twist_covariance=np.zeros(9), age=0.0,
    )  # fmt: skip


def heard(x, y, yaw=0.0, vx=0.0, robot="ann"):
    peer = Peer(robot=robot, pose=Pose2D(x=x, y=y, yaw=yaw), twist=Twist2D(vx=vx, vy=0.0, wz=0.0), heard=HEARD)
    return Peers(stamp=HEARD, received=HEARD, seq=0, frame="map", peers=(peer,))


def free(way, peers, *, own=None, after=0.0, seen=blind):
    guard = PeerGuard(GateConfig(), BODY, {"ann": BODY}, seen)
    guard.observe_pose(pose() if own is None else own)
    guard.observe(peers)
    return guard.free_distance([way], 0.5, HEARD + round(after * SECOND))


def test_a_robot_behind_ends_the_way_back_and_no_other():
    assert free(BACK, heard(-0.8, 0.0)) == pytest.approx(0.8 - 0.48 - 0.02, abs=0.021)
    assert free(AHEAD, heard(-0.8, 0.0)) == inf
    assert free(BACK, heard(-1.5, 0.0)) == inf
    assert free(BACK, heard(-0.8, 0.4)) == inf  # passed


def test_a_robot_aside_ends_a_turn_that_it_has_no_room_for():
    assert free(SPOT, heard(0.0, 0.39)) < 0.1
    assert free(SPOT, heard(0.0, 0.5)) == inf


def test_one_that_comes_from_behind_stops_nobody_who_drives_on():
    for way in (AHEAD, (1.0, 0.0, 1.25), (0.95, 0.31, 0.0)):
        assert free(way, heard(-0.69, 0.0, vx=0.3)) == inf
    assert free(BACK, heard(-0.69, 0.0, vx=0.3)) < 0.25


def test_places_are_those_in_the_map():
    assert free(BACK, heard(1.0, 2.8), own=pose(1.0, 2.0, -pi / 2)) == pytest.approx(0.37, abs=0.03)


def test_one_that_comes_nearer_counts_where_it_goes():
    assert free(BACK, heard(-1.1, 0.0, vx=0.2)) == pytest.approx(1.1 - 0.2 - 0.48 - 0.02, abs=0.021)


def test_a_silent_one_stays_where_it_was_for_half_a_minute():
    assert free(BACK, heard(-0.8, 0.0), after=29.0) < 0.4
    assert free(BACK, heard(-0.8, 0.0), after=31.0) == inf


def test_a_robot_where_the_lidar_looks_and_one_that_is_not_configured_do_not_count():
    assert free(BACK, heard(-0.8, 0.0), seen=lambda points: points[:, 0] < 0.0) == inf
    assert free(BACK, heard(-0.8, 0.0, robot="bob")) == inf


def test_without_a_pose_of_its_own_nobody_has_a_place():
    guard = PeerGuard(GateConfig(), BODY, {"ann": BODY}, blind)
    guard.observe(heard(-0.8, 0.0))
    assert guard.free_distance([BACK], 0.5, HEARD) == inf


def test_the_gate_stops_before_a_robot_behind_that_no_scan_has_seen():
    rig = Rig(obstacle=ANY_GROUND)
    rig.gate = make_gate(obstacle=ANY_GROUND, peers={"ann": Footprint()})
    rig.gate.observe_pose(pose())
    rig.driving(ticks=40, speed=-0.1)
    assert rig.out.reasons == ()
    rig.gate.observe_peers(heard(-0.55, 0.0))
    rig.tick(40)
    assert rig.out.reasons == (Reason.OBSTACLE_STOP,)
    assert rig.speed == 0.0
    rig.gate.observe_peers(heard(0.55, 0.0))  # before the lidar, which sees nobody
    rig.tick(40)
    assert rig.out.reasons == ()
