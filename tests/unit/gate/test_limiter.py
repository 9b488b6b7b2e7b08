"""The way from a request to the commanded motion, step by step: obstacles, target, steering, acceleration."""

import math

import numpy as np
import pytest

from monstertruck_kinematics.chassis import STILL
from monstertruck_kinematics.se2 import placed
from monstertruck_planners.collision import Footprint, ScanPoints
from monstertruck_runtime.clock import SECOND
from monstertruck_schemas.cmd import DriveAction
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import DriveRequest, RequestedTwist, Role
from monstertruck_schemas.state import GateMode
from monstertruckd.gate.config import GateConfig, InForce
from monstertruckd.gate.motion import Motion, _same
from monstertruckd.gate.obstacles import ObstacleCheck, ObstacleGuard
from tests.unit.gate.rig import ANY_GROUND, BODIES, CHASSIS, NONCE, TICK, Rig, Robot, check_of, header, scan

MS = SECOND // 1000
NOW = 10 * SECOND
FOOTPRINT = Footprint()
FRONT = FOOTPRINT.half_length
RADIUS = FOOTPRINT.circumscribed_radius
REACH = 0.05 + 0.21 * (0.25 + 0.4 + 0.08) + 0.21**2 / (2 * 0.15)
AHEAD = ((1.0, 0.0, 0.0),)
COVERED = ((-30.0, 30.0, 6),)
"""The sectors ahead."""


def guard(**config):
    return ObstacleGuard(InForce(GateConfig(**config)), FOOTPRINT, [ScanPoints((0.14, 0.0, 0.0))])


def looked(checked, *obstacles, at=NOW, ways=AHEAD, unknown=()):
    """Free distance after one more scan."""
    checked.observe(scan(at, *obstacles, unknown=unknown))
    return checked.free_distance(ways)


# Obstacles


def test_before_the_first_scan_there_is_no_obstacle():
    checked = guard()
    assert len(checked._points) == 0
    assert checked.free_distance(AHEAD) == math.inf


@pytest.mark.parametrize("gap", [0.0, 0.005, 0.015])
def test_beside_a_wall_nearer_than_the_side_clearance_it_may_drive_away_but_not_along_it(gap):
    wall = [(x, -FOOTPRINT.half_width - gap - 1e-4) for x in np.arange(0.04, 0.9, 0.01)]
    away, along = ((math.cos(0.33), math.sin(0.33), 0.0),), AHEAD
    assert looked(guard(), *wall, ways=away) == math.inf
    assert looked(guard(), *wall, ways=along) < 0.05
    assert looked(guard(), *wall, (0.5, 0.05), ways=away) < 0.3


def test_a_corner_that_moves_ahead_of_the_body_is_checked_to_the_end_of_its_reach():
    corner = math.atan2(FOOTPRINT.half_width, FOOTPRINT.half_length)
    way = (math.cos(corner), math.sin(corner), 0.0)
    far = RADIUS + REACH - 0.002
    assert looked(guard(), (far * way[0], far * way[1]), ways=(way,)) < REACH
    beyond = RADIUS + REACH + 0.05
    assert looked(guard(), (beyond * way[0], beyond * way[1]), ways=(way,)) == math.inf


@pytest.mark.parametrize("way", [(1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 5.0), (0.6, 0.0, 4.0), (0.1, 0.0, 0.0)])
def test_no_corner_moves_further_between_two_poses_than_the_base_does_straight_on(way):
    steps = tuple(round(part / 0.005) for part in way)
    sweep = guard()._sweep(*steps)
    distances, poses = sweep.distances, sweep.poses
    assert distances[-1] == pytest.approx(REACH)
    assert len(distances) == math.ceil(20 * max(math.hypot(way[0], way[1]) + abs(way[2]) * RADIUS, 1.0) - 1e-9)
    corner = (FOOTPRINT.half_length, FOOTPRINT.half_width, 0.0)
    corners = np.array([placed(np.array([corner]), tuple(pose))[0, :2] for pose in poses])
    moved = np.hypot(*np.diff(corners, axis=0).T)
    assert moved.max() <= REACH / 19 * 1.05


@pytest.mark.parametrize(("later", "kept"), [(1, True), (250 * MS, True), (250 * MS + 1, False)])
def test_an_obstacle_is_kept_while_its_sector_is_not_seen_and_the_view_before_is_not_too_old(later, kept):
    checked = guard()
    free = looked(checked, (FRONT + 0.2, 0.0))
    assert free < 0.2
    covered = looked(checked, at=NOW + later, unknown=COVERED)
    assert covered == (free if kept else math.inf)


@pytest.mark.parametrize("bearing", [0.0, math.pi / 2, -math.pi / 2, 0.8])
@pytest.mark.parametrize(("offset", "kept"), [(-0.01, 1), (0.01, 0)])
def test_obstacles_are_kept_as_far_off_as_any_corner_can_reach(bearing, offset, kept):
    checked = guard()
    distance = REACH + RADIUS + 0.02 + offset
    looked(checked, (distance * math.cos(bearing), distance * math.sin(bearing)))
    assert len(checked._points) == kept


def test_an_obstacle_kept_does_not_add_up():
    checked = guard()
    looked(checked, (FRONT + 0.2, 0.0))
    for step in range(1, 5):
        looked(checked, at=NOW + step * 10 * MS, unknown=COVERED)
    assert len(checked._points) == 1


def test_how_long_the_way_has_not_been_seen():
    checked = guard()
    looked(checked, unknown=COVERED)
    assert checked.unseen is None, "never"
    looked(checked, at=NOW + SECOND)
    assert checked.unseen == 0.0
    looked(checked, at=NOW + SECOND + 100 * MS, unknown=COVERED)
    assert checked.unseen == pytest.approx(0.1)
    assert checked.free_distance(((-1.0, 0.0, 0.0),)) == math.inf
    assert checked.unseen == 0.0, "another way"
    assert checked.free_distance((*AHEAD, (-1.0, 0.0, 0.0))) == math.inf
    assert checked.unseen == pytest.approx(0.1), "the worst of all ways"


def test_the_time_not_seen_and_the_scans_age_shorten_the_way_left():
    checked = guard()
    looked(checked)
    looked(checked, at=NOW + 100 * MS, unknown=COVERED)
    allowed = checked.allowed_speed(0.3, NOW + 150 * MS)
    delay = 0.05 + 0.1 + 0.08
    assert allowed * delay + allowed**2 / (2 * 0.15) == pytest.approx(0.25)


def test_a_scan_from_the_future_is_not_younger_than_new():
    checked = guard()
    looked(checked)
    assert checked.allowed_speed(0.3, NOW - SECOND) == checked.allowed_speed(0.3, NOW)


def test_a_scan_whose_sensors_clock_runs_ahead_is_as_old_as_its_arrival():
    ahead, right = guard(), guard()
    ahead.observe(scan(NOW).model_copy(update={"received": NOW - 300 * MS}))
    right.observe(scan(NOW - 300 * MS))
    for checked in (ahead, right):
        checked.free_distance(AHEAD)
    assert ahead.allowed_speed(0.3, NOW) == right.allowed_speed(0.3, NOW) < right.allowed_speed(0.3, NOW - 300 * MS)


def test_at_the_very_distance_of_an_ordinary_stop_it_is_not_too_near():
    checked = guard(deceleration=0.5, reaction=0.0)
    looked(checked)
    assert checked.too_near(0.2499, 0.5, NOW)
    assert not checked.too_near(0.25, 0.5, NOW)


# Target


def motion(chassis=CHASSIS, **config):
    return Motion(InForce(GateConfig(**config)), chassis)


def asked(speed=0.1, front=0.0, rear=0.0, twist=None):
    if twist is not None:
        twist, speed = RequestedTwist(**dict(zip(("vx", "vy", "wz"), twist, strict=True))), 0.0
    return DriveRequest(
        **header(NOW), nonce=NONCE, source="ann", role=Role.GAMEPAD, lease=1.0,
        speed=speed, front=front, rear=rear, twist=twist,
    )  # fmt: skip


@pytest.mark.parametrize("sign", [1, -1])
def test_speeds_beyond_all_measure_are_bounded_before_anything_else(sign):
    moved = motion()
    assert moved.target(asked(sign * 1e9)).twist[0] == sign * 1e3
    assert moved.target(asked(sign * 500.0)).twist[0] == sign * 500.0
    robot = motion(BODIES["mecanum"])
    assert robot.target(asked(twist=(sign * 4e3, 2e3, 1e3))).twist == pytest.approx((sign * 1e3, 500.0, 250.0))
    assert robot.target(asked(twist=(0.1, 0.0, sign * 900.0))).twist == pytest.approx((0.1, 0.0, sign * 900.0))


@pytest.mark.parametrize("axle", ["front", "rear"])
@pytest.mark.parametrize("sign", [1, -1])
def test_an_axle_at_its_limit_is_not_clipped_and_one_beyond_is(axle, sign):
    moved = motion(angle=0.25)
    assert not moved.target(asked(**{axle: sign * 0.25})).clipped
    beyond = moved.target(asked(**{axle: sign * 0.2501}))
    assert beyond.clipped
    assert not beyond.saturated


@pytest.mark.parametrize("sign", [1, -1])
def test_any_angle_of_a_request_is_taken_as_a_bounded_one(sign):
    found = motion().target(asked(front=sign * 100.0, rear=0.0))
    assert found.clipped
    assert found.twist[2] * sign > 0
    found = motion().target(asked(front=0.0, rear=sign * 100.0))
    assert found.twist[2] * sign < 0


def test_angles_within_all_limits_are_those_asked_for():
    front, rear = 0.1234, -0.0567
    assert motion().target(asked(front=front, rear=rear)).angles == (front, rear)


@pytest.mark.parametrize("lacking", [(0.9e-4, 0.0), (1.1e-4, 0.0), (0.0, -1.1e-4), (-1.1e-4, 0.0), (0.0, 0.0)])
def test_a_servo_that_lacks_part_of_its_angle_is_at_its_limit_whichever_it_is(lacking, monkeypatch):
    def reached(_chassis, angles):
        return tuple(angle - less for angle, less in zip(angles, lacking, strict=True))

    monkeypatch.setattr(type(CHASSIS), "reached", reached)
    found = motion().target(asked(front=0.1, rear=-0.05))
    assert found.saturated == found.clipped == (max(map(abs, lacking)) > 1e-4)


@pytest.mark.parametrize(("excess", "clipped"), [(0.5e-6, False), (1.5e-6, True)])
def test_what_is_beyond_a_limit_by_rounding_is_not_clipped(excess, clipped):
    rig = Rig().driving(speed=0.21 * (1 + excess))
    assert (Reason.CLIPPED in rig.out.reasons) is clipped
    assert _same((1.0, 1.0 + excess, 0.0), (1.0, 1.0, 0.0)) is not clipped
    assert _same((1.0, 1.0, excess), (1.0, 1.0, 0.0)) is not clipped


def test_a_twist_the_body_can_do_is_not_clipped():
    moved = motion(BODIES["mecanum"])
    found = moved.target(asked(twist=(0.1, 0.05, 0.2)))
    assert (found.twist, found.clipped, found.saturated) == ((0.1, 0.05, 0.2), False, False)


@pytest.mark.parametrize("kind", BODIES)
def test_standstill_is_commanded_until_something_moves(kind):
    moved = motion(BODIES[kind])
    assert moved.standing
    assert set(moved.shaft_speeds) == set(moved.motor_velocities) == {0.0}
    moved.accelerate(moved.along((0.1, 0.0, 0.0)), 1.0)
    assert not moved.standing
    assert moved.shaft_speeds == moved._chassis.shafts_along(moved.twist, *moved.angles)
    assert moved.motor_velocities == tuple(map(moved._chassis.drivetrain.motor_rate, moved.shaft_speeds))
    moved.halt()
    assert moved.standing
    assert set(moved.shaft_speeds) == {0.0}


def test_the_pace_is_the_greatest_speed_of_base_and_wheels():
    assert motion().pace((0.3, -0.4, 0.0)) >= 0.5 - 1e-12
    turning = motion(BODIES["differential"])
    assert turning.pace((0.0, 0.0, 1.0)) == pytest.approx(0.13, rel=0.01)
    assert turning.pace((0.1, 0.0, -1.0)) == pytest.approx(0.23, rel=0.01)


@pytest.mark.parametrize(
    ("twist", "limit"),
    [
        ((0.1, 0.0, 0.0), 0.21),
        ((-0.1, 0.0, 0.0), 0.15),
        ((0.0, 0.1, 0.0), 0.15),
        ((0.0, 0.0, 0.5), 0.15),
        ((0.1, 0.16, 0.0), 0.15),
        ((0.1, 0.02, 0.0), 0.21),
    ],
)
def test_what_goes_where_the_lidar_does_not_see_has_the_limit_of_reverse(twist, limit):
    assert motion(BODIES["mecanum"]).max_pace(twist) == limit


@pytest.mark.parametrize(("forward", "limit"), [(0.1, 0.21), (0.0999, 0.15)])
def test_a_motion_of_which_half_goes_ahead_has_the_limit_of_driving_ahead(forward, limit, monkeypatch):
    moved = motion()
    monkeypatch.setattr(moved, "pace", lambda *_: 0.2)
    assert moved.max_pace((forward, 0.0, 0.0)) == limit


def test_progress_is_the_measured_share_of_a_way():
    moved = motion(BODIES["differential"])
    way = (1.0, 0.0, 0.0)
    assert moved.progress((0.1, 0.1), way) == pytest.approx(0.1)
    assert moved.progress((-0.1, -0.1), way) == pytest.approx(-0.1)
    assert moved.progress((0.2, 0.1), way) == pytest.approx(0.15)
    assert moved.progress((0.1, 0.1), (-0.5, 0.0, 0.0)) == pytest.approx(-0.2)
    assert moved.progress((0.1, 0.1), (0.0, 0.0, 0.0)) == 0.0


def test_all_servos_complete_the_same_share_of_their_way():
    moved = motion(steering_rate=0.5)
    moved.steer((0.2, -0.1), 0.1)
    assert moved.angles == pytest.approx((0.05, -0.025))
    moved.steer((0.2, -0.1), 1.0)
    assert moved.angles == pytest.approx((0.2, -0.1))
    moved.steer((0.2, -0.1), 1.0)
    assert moved.angles == pytest.approx((0.2, -0.1))
    assert moved._chassis.steering(*moved.servos) == pytest.approx((0.2, -0.1), abs=1e-6)


def test_a_truck_that_steers_turns_with_its_wheels():
    moved = motion()
    moved.accelerate((0.1, 0.0, 0.0), 1.0)
    moved.steer((0.2, -0.2), 1.0)
    assert moved.twist == pytest.approx(CHASSIS.along((0.1, 0.0, 0.0), 0.2, -0.2))
    assert moved.twist[2] > 0.05
    assert moved.axle_angles == pytest.approx((0.2, -0.2))


def test_speed_changes_at_the_rate_of_its_direction_and_ends_exactly_at_the_target():
    moved = motion(BODIES["mecanum"])
    moved.accelerate((0.1, 0.0, 0.0), 0.02)
    assert moved.twist == pytest.approx((0.01, 0.0, 0.0)), "0.5 m/s^2"
    moved.accelerate((0.1, 0.0, 0.0), 1.0)
    moved.accelerate((0.0, 0.0, 0.0), 0.02)
    assert moved.twist == pytest.approx((0.08, 0.0, 0.0)), "1 m/s^2"
    for target in ((0.1, 0.07, 0.3), (0.03, -0.07, -0.1), (1 / 3, 0.1, 0.7), (0.1, 0.0, 0.0), STILL):
        moved.accelerate(target, 10.0)
        assert moved.twist == target


def test_a_motion_of_the_same_pace_in_another_direction_is_reached_by_braking():
    moved = motion(BODIES["omni"])
    moved.accelerate((0.1, 0.0, 0.0), 1.0)
    equal = (0.0, 0.1 * moved.pace((1.0, 0.0, 0.0)) / moved.pace((0.0, 1.0, 0.0)), 0.0)
    step = moved.pace((equal[0] - 0.1, equal[1], 0.0))
    growing = moved.pace(equal) > moved.pace(moved.twist)
    moved.accelerate(equal, 0.02)
    share = 0.02 * (0.5 if growing else 1.0) / step
    assert moved.twist[0] == pytest.approx(0.1 * (1 - share))


# All of it, in the gate


def ahead(rig):
    """What the gate knows of the way ahead."""
    return check_of(rig.gate, ObstacleCheck)._approach


def wall(distance):
    return tuple((FRONT + distance, y / 100) for y in range(-15, 16, 3))


def test_before_a_way_was_checked_nothing_stops_the_truck():
    way = ahead(Rig())
    assert (way.blocked, way.emergency, way.free) == (False, False, None)


def test_standstill_forgets_what_stopped_the_truck():
    way = ahead(Rig())
    way.blocked = way.emergency = True
    way.free = 0.1
    way.forget()
    assert (way.blocked, way.emergency, way.free) == (False, False, None)


def test_a_truck_at_rest_before_a_wall_does_not_set_off():
    rig = Rig().armed()
    rig.obstacles = wall(0.04)
    rig.driver = {"speed": 0.2}
    for _ in range(20):
        rig.tick()
        assert rig.out.speeds == (0.0,)
    assert Reason.OBSTACLE_STOP in rig.out.reasons
    assert rig.trips == [], "nothing was stopped"


@pytest.mark.parametrize(("speed", "action"), [(0.01, DriveAction.RUN), (0.0101, DriveAction.QUICK_STOP)])
def test_a_truck_approaches_from_more_than_standstill_on(speed, action, monkeypatch):
    rig = Rig().driving(speed=0.1)
    monkeypatch.setattr(rig.gate._motion, "progress", lambda *_: speed)
    rig.obstacles = wall(0.01)
    rig.tick()
    assert rig.out.action is action


def test_what_stops_a_slow_truck_in_time_is_no_quick_stop():
    rig = Rig().driving(speed=0.03)
    rig.obstacles = wall(0.06)
    rig.tick()
    assert Reason.OBSTACLE_STOP in rig.out.reasons
    assert rig.out.action is DriveAction.RUN
    assert not rig.trips[-1].quick


def test_a_limit_at_the_present_pace_limits_nothing(monkeypatch):
    rig = Rig().driving(speed=0.2)
    rig.obstacles = wall(0.3)
    guard = check_of(rig.gate, ObstacleCheck).guard
    for allowed, limited in ((0.2, False), (0.199, True)):
        monkeypatch.setattr(guard, "allowed_speed", lambda _free, _now, allowed=allowed: allowed)
        rig.speed = rig.out.speeds[0]
        rig.tick()
        assert (Reason.OBSTACLE_SLOW in rig.out.reasons) is limited
        assert (Reason.UNSEEN_SLOW in rig.out.reasons) is limited


def test_a_truck_that_was_stopped_by_an_obstacle_goes_on_at_twice_the_speed_below_which_it_stops(monkeypatch):
    rig = Rig().driving(speed=0.2)
    rig.obstacles = wall(0.3)
    guard = check_of(rig.gate, ObstacleCheck).guard
    for allowed, blocked in ((0.0201, False), (0.0199, True), (0.0399, True), (0.0401, False), (0.0201, False)):
        monkeypatch.setattr(guard, "allowed_speed", lambda _free, _now, allowed=allowed: allowed)
        rig.tick()
        assert (Reason.OBSTACLE_STOP in rig.out.reasons) is blocked
        assert (Reason.OBSTACLE_SLOW in rig.out.reasons) is not blocked


def test_a_truck_at_rest_and_one_of_unknown_speed_need_no_distance_to_stop():
    rig = Rig(deceleration=0.8)
    rig.silent = {"drive"}
    rig.tick()
    assert rig.out.stopping_distance == 0.0
    rig.silent = set()
    rig.tick()
    assert rig.out.stopping_distance == 0.0
    rig.speed = -0.2
    rig.tick()
    assert rig.out.stopping_distance == pytest.approx(0.2 * 0.08 + 0.2**2 / 1.6)


def test_without_an_obstacle_no_distance_is_reported_for_it():
    rig = Rig().driving(speed=0.1)
    assert ahead(rig).free is None
    rig.obstacles = [(0.6, 0.0)]
    rig.tick(10)
    assert ahead(rig).free == pytest.approx(0.6 - FOOTPRINT.half_length - FOOTPRINT.offset, abs=0.05)


def test_what_appears_before_a_truck_that_brakes_is_a_quick_stop():
    rig = Rig(deceleration=0.3).driving(speed=0.2)
    rig.driver = {"speed": 0.0}
    rig.tick()
    assert rig.out.speeds[0] > 0
    rig.obstacles = wall(0.04)
    rig.tick()
    assert rig.out.action is DriveAction.QUICK_STOP
    assert rig.trips[-1].quick


def test_a_quick_stop_before_an_obstacle_goes_on_until_the_truck_rests():
    rig = Rig().driving(speed=0.2)
    rig.obstacles = wall(0.04)
    rig.tick()
    assert rig.out.action is DriveAction.QUICK_STOP
    while rig.speed > 0.03:
        rig.tick()
        assert rig.out.action is DriveAction.QUICK_STOP
    rig.tick(3)
    assert rig.out.action is DriveAction.RUN
    assert rig.out.mode is GateMode.DRIVING


def test_an_obstacle_slows_before_the_speed_is_reached():
    rig = Rig().armed()
    rig.obstacles = wall(0.15)
    rig.driver = {"speed": 0.21}
    rig.tick()
    assert Reason.OBSTACLE_SLOW in rig.out.reasons
    assert 0.02 < rig.out.speed_limit < 0.15


def test_an_obstacle_that_allows_what_is_asked_says_nothing():
    rig = Rig().armed()
    rig.obstacles = wall(0.2)
    rig.driver = {"speed": 0.05}
    rig.tick(5)
    assert rig.out.reasons == ()
    assert rig.out.speed_limit == 0.21


def test_without_feedback_of_a_drive_that_is_not_critical_no_stop_is_a_quick_one():
    rig = Rig(drive={"stale_after": 0.2, "critical": False})
    rig.silent = {"drive"}
    rig.driving(speed=0.2)
    rig.obstacles = wall(0.04)
    rig.tick()
    assert Reason.OBSTACLE_STOP in rig.out.reasons
    assert rig.out.action is DriveAction.RUN


def test_a_lidar_that_is_not_critical_and_silent_checks_nothing():
    rig = Rig(scan={"stale_after": 0.25, "critical": False}).driving(speed=0.1)
    rig.obstacles = wall(0.3)
    rig.tick()
    rig.silent = {"scan"}
    rig.tick(40)
    assert rig.out.speeds == (0.1,)


def test_the_lidar_may_be_blind_for_as_long_as_a_scan_counts():
    rig = Rig().driving(speed=0.1)
    rig.unknown = COVERED
    rig.tick(12)
    assert Reason.LIDAR_SLOW in rig.out.reasons
    assert Reason.LIDAR_BLIND not in rig.out.reasons
    rig.tick(1)
    assert Reason.LIDAR_BLIND in rig.out.reasons
    unseen = {figure.name: figure for cause in rig.trips[-1].causes for figure in cause.measurements}["unseen"]
    assert (unseen.unit, unseen.limit) == ("s", 0.25)
    assert unseen.value == pytest.approx(0.26)


def test_a_sideways_body_turns_its_wheels_before_it_moves_and_only_at_rest():
    robot = Robot("wheels", obstacle=ANY_GROUND).armed()
    robot.driver = {"vx": 0.1}
    robot.tick(20)
    ahead = robot.out.servos
    robot.driver = {"vy": 0.1}
    robot.tick()
    assert robot.out.servos == ahead, "it still rolls"
    robot.tick(200)
    assert robot.out.twist == pytest.approx((0.0, 0.1, 0.0), abs=1e-6)


def test_a_second_of_pause_between_ticks_is_two_ticks_of_steering():
    rig = Rig(tick_stall=5.0, steering_rate=0.5).armed()
    rig.driver = {"speed": 0.0, "front": 0.4}
    rig.tick()
    before = rig.out.front
    rig.now += 9 * TICK
    rig.tick()
    assert rig.out.front - before == pytest.approx(0.5 * 0.04, rel=0.05)
