"""A follower on the way of its leader: distance, corners, silence; on robots that do what they are asked for."""

import itertools
import math

import numpy as np
import pytest

from monstertruck_kinematics.chassis import Dimensions, differential_chassis, synchro_chassis
from monstertruck_kinematics.elementary import KinematicsError
from monstertruck_kinematics.se2 import integrate
from monstertruck_kinematics.truck import DriveTrain
from monstertruck_planners.behave.api import BehaviourBody, Inputs
from monstertruck_planners.behave.follow import FollowConfig, LeaderFollower
from monstertruck_runtime.clock import SECOND
from monstertruck_schemas.base import Pose2D, Twist2D
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.state import Peer, Peers
from monstertruck_schemas.topics import PEERS, POSE
from tests.unit.planners.behave.wall_kit import odometry

BODY = BehaviourBody(differential_chassis(Dimensions(DriveTrain())), 0.4)
PERIOD = 0.1


def heard(pose, twist, at, *, now, robot="ann"):
    peer = Peer(
        robot=robot,
        pose=Pose2D(x=pose[0], y=pose[1], yaw=math.remainder(pose[2], math.tau)),
        twist=Twist2D(vx=twist[0], vy=0.0, wz=twist[1]),
        heard=round(at * SECOND),
    )
    return Peers(stamp=round(now * SECOND), received=round(now * SECOND), seq=0, peers=(peer,))


def run(leader, *, seconds=40.0, start=(-1.5, 0.0, 0.0), silent_from=math.inf, **settings):
    """``leader(t)`` is its (v, w); rows of t, step, follower's pose, leader's pose."""
    behaviour = LeaderFollower(FollowConfig(leader="ann", **settings), BODY)
    state, me, it, rows, twist = behaviour.begin(), start, (0.0, 0.0, 0.0), [], (0.0, 0.0)
    for i in range(round(seconds / PERIOD)):
        t = i * PERIOD
        v, w = leader(t)
        it = integrate(it, v, 0.0, w, PERIOD)
        peers = heard(it, (v, w), min(t, silent_from), now=t)
        own = odometry(x=me[0], y=me[1], yaw=math.remainder(me[2], math.tau), vx=twist[0], wz=twist[1])
        step = behaviour.step(Inputs({POSE.name: own, PEERS.name: peers}), state, t)
        state = step.state
        rows.append((t, step, me, it))
        if step.outcome is not Reason.DRIVING:
            break
        twist = (0.0, 0.0) if step.motion is None else (step.motion.vx, step.motion.wz)
        me = integrate(me, twist[0], 0.0, twist[1], PERIOD)
    return rows


def test_it_closes_up_keeps_the_distance_and_waits_behind_a_leader_that_stands():
    rows = run(lambda t: (0.15 if t < 20.0 else 0.0, 0.0))
    assert rows[195][1].values["gap"] == pytest.approx(1.0, abs=0.03)
    assert rows[-1][1].phase == "wait"
    assert rows[-1][1].motion is None
    assert rows[-1][3][0] - rows[-1][2][0] == pytest.approx(1.0, abs=0.03)
    assert max(0.0 if step.motion is None else step.motion.vx for _, step, _, _ in rows) <= 0.2


def test_it_drives_the_leaders_way_and_not_straight_towards_it():
    """The leader drives round a half circle: the follower stays on it."""
    rows = run(lambda t: (0.15, 0.0 if t < 15.0 else 0.15 if t < 36.0 else 0.0), seconds=60.0)
    way = np.array([it[:2] for *_, it in rows])
    off = [np.hypot(*(way - me[:2]).T).min() for t, _, me, _ in rows if t > 20.0]
    assert max(off) < 0.12
    assert rows[-1][1].values["gap"] == pytest.approx(1.0, abs=0.1)


def test_a_leader_that_comes_nearer_makes_it_wait_not_flee():
    rows = run(lambda t: (-0.1, 0.0), seconds=8.0, start=(-1.05, 0.0, 0.0))
    assert all(step.motion is None or step.motion.vx >= 0.0 for _, step, _, _ in rows)
    assert rows[-1][1].phase == "wait"


def test_it_stops_when_the_leader_is_silent_and_says_so():
    t, step, *_ = run(lambda t: (0.15, 0.0), silent_from=5.0)[-1]
    assert step.outcome is Reason.INPUT_STALE
    assert step.motion is None
    assert step.text == "ann has been silent for 0.60 s"
    assert t == pytest.approx(5.6, abs=0.01)


def test_a_leader_that_was_never_heard_and_one_that_is_too_far_end_it():
    behaviour = LeaderFollower(FollowConfig(leader="bob"), BODY)
    peers = heard((0.0, 0.0, 0.0), (0.0, 0.0), 1.0, now=1.0)
    inputs = Inputs({POSE.name: odometry(), PEERS.name: peers})
    assert behaviour.step(inputs, behaviour.begin(), 0.0).text == "no pose of bob received yet"
    far = run(lambda t: (0.0, 0.0), start=(-7.0, 0.0, 0.0))[-1][1]
    assert far.outcome is Reason.PATH_LOST
    assert "7.0 m away" in far.text


def test_a_leader_that_was_put_elsewhere_begins_a_new_way():
    behaviour = LeaderFollower(FollowConfig(leader="ann"), BODY)
    state = behaviour.begin()
    for i, x in enumerate((1.0, 1.03, 1.06, 3.0)):
        peers = heard((x, 0.0, 0.0), (0.1, 0.0), i * PERIOD, now=i * PERIOD)
        state = behaviour.step(Inputs({POSE.name: odometry(), PEERS.name: peers}), state, i * PERIOD).state
    assert state.points == ((3.0, 0.0),)


def test_the_trail_is_bounded():
    rows = run(lambda t: (0.0 if t < 1.0 else 0.4, 0.3), seconds=120.0, lost=20.0, speed=0.01)
    points = rows[-1][1].state.points
    assert len(points) <= 400
    assert all(math.dist(a, b) < 0.2 for a, b in itertools.pairwise(points))


def test_a_body_that_cannot_turn_is_refused():
    with pytest.raises(KinematicsError, match="keeps its heading"):
        LeaderFollower(FollowConfig(leader="ann"), BehaviourBody(synchro_chassis(Dimensions(DriveTrain())), 0.4))
