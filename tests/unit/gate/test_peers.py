"""Other robots by what they say of themselves: they stop the robot where no lidar looks, silent ones slow it."""

from math import inf, pi

import numpy as np
import pytest

from monstertruck_planners.collision import Footprint
from monstertruck_runtime.clock import SECOND
from monstertruck_schemas.base import Pose2D, Twist2D
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.state import Odometry, Peer, Peers
from monstertruckd.gate.config import GateConfig, InForce
from monstertruckd.gate.peers import PeerGuard
from tests.unit.gate.rig import ANY_GROUND, TICK, Rig, make_gate, show

AHEAD, BACK, SPOT = (1.0, 0.0, 0.0), (-1.0, 0.0, 0.0), (0.0, 0.0, 4.0)
BODY = Footprint(0.48, 0.34, padding=0.0)
HEARD = 100 * SECOND
SILENT = (Reason.PEER_UNKNOWN,)


def pose(x=0.0, y=0.0, yaw=0.0, vx=0.0, now=HEARD, deviation=0.0):
    return Odometry(
        stamp=now, received=now, seq=0, frame="map", pose=Pose2D(x=x, y=y, yaw=yaw),
        twist=Twist2D(vx=vx, vy=0.0, wz=0.0), pose_covariance=np.diag([deviation**2, 0.0, 0.0]).ravel(),
        twist_covariance=np.zeros(9), age=0.0,
    )  # fmt: skip


def heard(x, y, yaw=0.0, vx=0.0, robot="ann", now=HEARD, deviation=0.0):
    twist = Twist2D(vx=vx, vy=0.0, wz=0.0)
    peer = Peer(robot=robot, pose=Pose2D(x=x, y=y, yaw=yaw), twist=twist, deviation=deviation, heard=now)
    return Peers(stamp=now, received=now, seq=0, frame="map", peers=(peer,))


def free(way, peers, *, own=None, after=0.0, seen=None):
    now = HEARD + round(after * SECOND)
    guard = PeerGuard(InForce(GateConfig()), BODY, {"ann": BODY})
    guard.observe_pose(pose(now=now) if own is None else own)
    guard.observe(peers)
    return guard.free_distance([way], 0.5, now, seen)


def test_a_robot_behind_ends_the_way_back_and_no_other():
    assert free(BACK, heard(-0.8, 0.0)) == pytest.approx(0.8 - 0.48 - 0.02, abs=0.021)
    assert free(AHEAD, heard(-0.8, 0.0)) == inf
    assert free(BACK, heard(-1.5, 0.0)) == inf
    assert free(BACK, heard(-0.8, 0.4)) == inf  # passed


def test_a_robot_aside_ends_a_turn_that_it_has_no_room_for():
    assert free(SPOT, heard(0.0, 0.39)) < 0.1
    assert free(SPOT, heard(0.0, 0.5)) == inf


def test_a_turned_ellipse_counts_by_its_longest_axis():
    turned = pose().model_copy(update={"pose_covariance": (0.05, 0.03, 0.0, 0.03, 0.05, 0.0, 0.0, 0.0, 0.1)})
    assert turned.position_deviation == pytest.approx(0.08**0.5)
    assert pose(deviation=0.3).position_deviation == pytest.approx(0.3)


def test_poses_that_are_not_sure_keep_robots_further_apart():
    sure = free(BACK, heard(-0.9, 0.0))
    assert free(BACK, heard(-0.9, 0.0, deviation=0.06)) == pytest.approx(sure - 0.12, abs=0.021)
    both = free(BACK, heard(-0.9, 0.0, deviation=0.06), own=pose(deviation=0.08))
    assert both == pytest.approx(sure - 0.2, abs=0.021)
    assert free(AHEAD, heard(-0.6, 0.0, deviation=0.2)) == inf, "one may always drive away"


def test_poses_that_tell_no_place_make_the_robot_slow_and_close_no_more_ground():
    guard = PeerGuard(InForce(GateConfig()), BODY, {"ann": BODY})
    guard.observe_pose(pose(deviation=0.2))
    guard.observe(heard(-9.0, 0.0, deviation=0.2))
    assert not guard.unknown(HEARD)
    guard.observe(heard(-9.0, 0.0, deviation=0.25))
    assert guard.unknown(HEARD)
    assert free(BACK, heard(-1.5, 0.0, deviation=9.0)) == free(BACK, heard(-1.5, 0.0, deviation=0.3)) > 0.3


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


def test_both_robots_are_where_their_motion_has_taken_them_since():
    near = 0.8 - 0.48 - 0.02
    assert free(BACK, heard(-1.1, 0.0, vx=0.2), after=0.4) == pytest.approx(near + 0.02, abs=0.021)
    assert free(BACK, heard(-0.4, 0.0, vx=-1.0), after=0.4) == pytest.approx(near, abs=0.021)
    assert free(BACK, heard(-0.9, 0.0), own=pose(vx=-0.25), after=0.4) == pytest.approx(near, abs=0.021)


def test_without_a_fresh_pose_of_its_own_nobody_has_a_place_and_may_be_anywhere():
    guard = PeerGuard(InForce(GateConfig()), BODY, {"ann": BODY})
    guard.observe(heard(-0.8, 0.0))
    for own, known in ((None, False), (pose(now=HEARD - 6 * SECOND // 10), False), (pose(), True)):
        if own is not None:
            guard.observe_pose(own)
        assert (guard.free_distance([BACK], 0.5, HEARD, None) < 0.5) is known
        assert guard.unknown(HEARD) is not known


@pytest.mark.parametrize(("after", "unknown"), [(0.4, False), (0.6, True), (100.0, True)])
def test_one_that_is_silent_may_be_anywhere_until_it_is_heard_again(after, unknown):
    now = HEARD + round(after * SECOND)
    guard = PeerGuard(InForce(GateConfig()), BODY, {"ann": BODY})
    guard.observe_pose(pose(now=now))
    assert guard.unknown(now), "never heard"
    guard.observe(heard(-9.0, 0.0))
    assert guard.unknown(now) is unknown
    guard.observe(heard(-9.0, 0.0, now=now))
    assert not guard.unknown(now)


def peer_rig(**config):
    rig = Rig(**config)
    rig.gate = make_gate(peers={"ann": Footprint()}, **config)
    return rig


def beside(rig, x=None, ticks=40):
    """Drive for some ticks, hearing another robot ahead or behind; None = nobody."""
    for _ in range(ticks):
        show(rig.gate, pose(now=rig.now + TICK))
        if x is not None:
            show(rig.gate, heard(x, 0.0, now=rig.now + TICK))
        rig.tick()


def test_the_gate_stops_before_a_robot_behind_that_no_scan_has_seen():
    rig = peer_rig(obstacle=ANY_GROUND)
    rig.driving(ticks=1, speed=-0.1)
    beside(rig, 5.0)
    assert rig.out.reasons == ()
    beside(rig, -0.55)
    assert rig.out.reasons == (Reason.OBSTACLE_STOP,)
    assert rig.speed == 0.0
    beside(rig, 0.55)  # before the lidar, which sees nobody
    assert rig.out.reasons == ()


@pytest.mark.parametrize(("speed", "slow"), [(-0.14, 0.1), (-0.09, None), (0.2, None)])
def test_the_gate_is_slow_where_the_lidar_does_not_look_while_another_robot_is_silent(speed, slow):
    rig = peer_rig(obstacle={"unseen": "slow"})
    rig.driving(ticks=1, speed=speed)
    beside(rig)
    assert (Reason.PEER_UNKNOWN in rig.out.reasons) is (slow is not None)
    assert rig.speed == pytest.approx(speed if slow is None else -slow)


@pytest.mark.parametrize(
    ("place", "reasons", "speed"), [(5.0, (), 0.2), (0.55, (Reason.OBSTACLE_STOP,), 0.0), (None, SILENT, 0.1)]
)
def test_a_robot_without_range_sensors_goes_by_what_it_hears_all_around(place, reasons, speed):
    rig = peer_rig(scan={"stale_after": 0.25, "critical": False})
    rig.silent.add("scan")
    rig.driving(ticks=1, speed=0.2)
    beside(rig, place)
    assert rig.out.reasons == reasons
    assert rig.speed == pytest.approx(speed)


@pytest.mark.parametrize("away", [0.37, 0.42, 0.47])
def test_a_robot_that_is_there_now_never_vanishes_however_near(away):
    """Only where it is predicted to come too near the prediction ends."""
    for vx in (0.0, 0.3):
        assert free(BACK, heard(-away, 0.0, vx=vx)) == 0.0
