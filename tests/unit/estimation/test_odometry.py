"""Dead reckoning: from readings to poses, its covariance, and its service."""

import asyncio
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from monstertruck_estimation.odometry import OdometryService, PlanarCovariance
from monstertruck_kinematics.chassis import Dimensions, truck_chassis
from monstertruck_runtime.clock import SECOND, run_virtual
from monstertruck_schemas.reasons import Reason
from tests.unit.estimation.kit import DRIVETRAIN, Truck, drive_feedback, heading, servo_feedback, spread


def test_nothing_is_known_before_the_first_drive_reading():
    truck = Truck()
    truck.reckoning._wheels._turns = None
    assert truck.estimate is None


@pytest.mark.parametrize(
    ("speed", "front", "rear", "seconds"),
    [
        (0.2, 0.0, 0.0, 10.0),
        (-0.15, 0.0, 0.0, 5.0),
        (0.2, 0.3, 0.0, 12.0),
        (0.2, 0.35, -0.35, 12.0),
        (-0.15, -0.3, 0.3, 8.0),
        (0.08, 0.3, 0.3, 10.0),
    ],
    ids=["straight", "backwards", "front-steered circle", "counter-steered circle", "reverse circle", "crab"],
)
def test_a_steady_motion_is_followed_exactly(speed, front, rear, seconds):
    truck = Truck()
    truck.reckoning.observe_steering(servo_feedback(truck.now, front, rear))
    truck.reckoning.observe_drive(drive_feedback(truck.now + 1, truck.motor))
    truck.drive(speed, front, rear, seconds)
    position, yaw = truck.error()
    assert position < 1e-3
    assert yaw < 1e-3
    assert np.hypot(*truck.estimate.twist[:2]) == pytest.approx(abs(speed), rel=1e-3)


def test_crab_keeps_the_yaw():
    truck = Truck()
    truck.drive(0.08, 0.3, 0.3, 5.0)
    assert truck.estimate.pose[2] == pytest.approx(0.0, abs=2e-3)
    assert truck.estimate.pose[1] > 0.1


def test_a_full_circle_closes():
    truck = Truck()
    truck.drive(0.2, 0.3, -0.3, 0.05)
    start = truck.pose
    length = math.tau / abs(0.2 * 2 * math.tan(0.3) / 0.32)
    truck.drive(0.2, 0.3, -0.3, length)
    assert math.hypot(truck.pose[0] - start[0], truck.pose[1] - start[1]) < 0.01
    assert truck.error()[0] < 0.01


def test_the_start_is_configured():
    truck = Truck(start={"x": 1.0, "y": -2.0, "yaw": math.pi / 2})
    truck.drive(0.2, 0.0, 0.0, 5.0)
    assert truck.estimate.pose == pytest.approx((1.0, -1.0, math.pi / 2), abs=1e-9)


def test_yaw_stays_in_one_turn():
    truck = Truck()
    truck.drive(0.2, 0.3, -0.3, 40.0)
    assert truck.pose[2] > 2 * math.pi
    assert abs(truck.estimate.pose[2]) <= math.pi
    assert truck.error()[1] < 0.01


def test_the_pose_is_predicted_between_readings():
    truck = Truck()
    truck.drive(0.2, 0.0, 0.0, 1.0)
    ahead = truck.reckoning.estimate(truck.now + SECOND // 50)
    assert ahead.pose[0] == pytest.approx(truck.pose[0] + 0.2 * 0.02)
    assert ahead.age == pytest.approx(0.02)


def test_covariance_grows_with_the_way_and_with_age():
    truck = Truck()
    sizes = []
    for _ in range(4):
        truck.drive(0.2, 0.0, 0.0, 2.0)
        sizes.append(spread(truck.estimate.pose_covariance))
    assert (np.diff(sizes, axis=0) > 0).all()
    ages = [spread(truck.reckoning.estimate(truck.now + i * SECOND // 10).pose_covariance) for i in range(20)]
    assert (np.diff(ages, axis=0) > 0).all()


def test_standing_still_costs_no_certainty():
    truck = Truck()
    truck.drive(0.2, 0.0, 0.0, 2.0)
    before = truck.estimate.pose_covariance
    truck.drive(0.0, 0.0, 0.0, 10.0)
    assert truck.estimate.pose_covariance == pytest.approx(before, abs=1e-6)


def test_a_prediction_does_not_run_on_for_ever():
    truck = Truck()
    truck.drive(0.2, 0.0, 0.0, 1.0)
    far = truck.reckoning.estimate(truck.now + 5 * SECOND)
    assert far.pose[0] == pytest.approx(truck.pose[0] + 0.2 * 0.3)
    assert far.twist == (0.0, 0.0, 0.0), "a pose that waits has no speed"
    assert spread(far.pose_covariance)[0] > 0.2 * 4.7, "the truck may have driven on"
    assert spread(far.twist_covariance)[0] > 0.2


def test_sideways_uncertainty_comes_from_the_heading():
    truck = Truck()
    truck.drive(0.2, 0.0, 0.0, 25.0)
    x, y, _ = spread(truck.estimate.pose_covariance)
    assert y > 3 * x


def test_a_drive_that_counts_anew_does_not_move_the_truck():
    truck = Truck()
    truck.drive(0.2, 0.0, 0.0, 2.0)
    before, sure = truck.estimate.pose, spread(truck.estimate.pose_covariance)
    truck.motor = 0.0
    truck.now += SECOND // 20
    truck.reckoning.observe_drive(drive_feedback(truck.now, 0.0))
    assert truck.estimate.pose == pytest.approx(before)
    assert (spread(truck.estimate.pose_covariance) > sure).all()
    assert truck.estimate.twist == (0.0, 0.0, 0.0)
    truck.drive(0.2, 0.0, 0.0, 1.0)
    assert truck.estimate.pose[0] == pytest.approx(before[0] + 0.2, abs=1e-3)


def test_readings_out_of_order_are_left_out():
    truck = Truck()
    truck.drive(0.2, 0.0, 0.0, 1.0)
    before = truck.estimate.pose
    truck.reckoning.observe_drive(drive_feedback(truck.now, truck.motor + 1e3))
    truck.reckoning.observe_drive(drive_feedback(truck.now - SECOND, truck.motor - 1e3))
    assert truck.estimate.pose == before


# Compass


def lap(truck, laps=3):
    for _ in range(laps):
        truck.drive(0.2, 0.0, 0.0, 10.0)
        truck.drive(0.2, 0.3, -0.3, 8.0)
    return truck


def noisy(sigma, seed=1):
    rng = np.random.default_rng(seed)
    return lambda _: rng.normal(0.0, sigma)


def test_without_a_compass_the_heading_drifts_with_it_it_stays_bounded():
    drifting = Truck(compass=None)
    held = Truck(compass_error=noisy(math.radians(0.5)))
    for truck in (drifting, held):
        truck.reckoning._wheels._chassis = truck_chassis(Dimensions(DRIVETRAIN, wheelbase=0.34))  # a wrong wheelbase
        lap(truck, laps=5)
    assert drifting.error()[1] > 0.3
    assert held.error()[1] < math.radians(5)
    assert held.error()[0] < drifting.error()[0]
    assert spread(held.estimate.pose_covariance)[2] < spread(drifting.estimate.pose_covariance)[2] / 2
    assert "compass" in held.estimate.sources
    assert "compass" not in drifting.estimate.sources


def test_noise_of_the_compass_hardly_moves_a_good_heading():
    truck = lap(Truck(compass_error=noisy(math.radians(0.5))))
    assert truck.error()[1] < math.radians(0.5)
    assert truck.error()[0] < 0.05
    assert truck.reckoning.rejected_headings == 0


def test_north_is_found_while_standing():
    truck = Truck(compass_error=noisy(math.radians(0.5)), start={"x": 0.0, "y": 0.0, "yaw": 1.2})
    truck.drive(0.0, 0.0, 0.0, 2.0)
    assert truck.estimate.pose[2] == pytest.approx(1.2, abs=1e-3)
    assert math.remainder(truck.reckoning._north + truck.north + 1.2, math.tau) == pytest.approx(0.0, abs=0.01)


def test_driving_off_early_aligns_with_what_is_there():
    truck = Truck(compass_error=noisy(0.0), compass={"alignment": 1000})
    truck.drive(0.2, 0.0, 0.0, 2.0)
    assert truck.reckoning._north is not None


def test_disturbed_headings_are_ignored():
    truck = Truck(compass_error=noisy(0.0))
    truck.drive(0.2, 0.0, 0.0, 2.0)
    before = truck.estimate.pose
    for _ in range(50):
        truck.reckoning.observe_attitude(heading(truck.now, 0.1, disturbed=True))
    assert truck.estimate.pose == before


def test_a_sudden_turn_of_the_compass_alone_is_rejected():
    truck = Truck(compass_error=lambda truck: 0.6 if truck.now > 5 * SECOND else 0.0)
    truck.drive(0.2, 0.0, 0.0, 6.0)
    assert truck.error()[1] < 0.01
    assert truck.reckoning.rejected_headings > 10


def test_a_compass_of_the_wrong_sign_is_found_by_its_turns_and_taken_back():
    truck = Truck(compass_error=lambda truck: -2.0 * truck.pose[2])
    truck.drive(0.2, 0.0, 0.0, 1.0)
    assert truck.reckoning.doubt is None
    truck.drive(0.2, 0.04, -0.04, 6.0)  # so slowly that no heading is far off
    assert truck.reckoning.rejected_headings == 0
    assert "check the compass's sign" in truck.reckoning.doubt
    assert truck.error()[1] < 0.01
    x, y, _ = spread(truck.estimate.pose_covariance)
    assert truck.error()[0] < 3 * math.hypot(x, y)
    truck.compass_error = lambda truck: 0.4
    truck.drive(0.2, 0.3, -0.3, 3.0)
    assert truck.reckoning.doubt is None, "it turns with the truck again"
    assert "compass" in truck.estimate.sources
    assert truck.error()[1] < 0.02, "north was found anew"


def test_headings_that_stay_off_are_reported_and_their_return_is():
    reported = []
    truck = Truck(compass_error=lambda truck: 0.6 if 3.0 < truck.now / SECOND < 5.0 else 0.0)
    service = OdometryService(
        truck.reckoning,
        None,
        drives=[],
        steering=None,
        compass=None,
        odometry=None,
        pose=None,
        events=lambda reason, *_: reported.append(reason),
    )
    for _ in range(6):
        truck.drive(0.2, 0.0, 0.0, 1.0)
        service.report_compass(truck.reckoning.doubt)
    assert reported == [Reason.HEADING_DISTURBED, Reason.HEADING_RETURNED]


def test_headings_before_the_first_drive_reading_are_ignored():
    truck = Truck()
    truck.reckoning._wheels._turns = None
    truck.reckoning.observe_attitude(heading(truck.now, 0.1))
    assert truck.reckoning._aligning == []


def test_sources_tell_what_the_estimate_rests_on():
    truck = Truck()
    assert truck.estimate.sources == ("drive",)
    truck = Truck(compass_error=noisy(0.0))
    truck.drive(0.2, 0.0, 0.0, 2.0)
    assert truck.estimate.sources == ("drive", "steering", "compass")
    assert truck.reckoning.estimate(truck.now + 2 * SECOND).sources == ()


def test_servo_angles_that_nobody_vouches_for_are_left_out():
    truck = Truck()
    truck.drive(0.2, 0.3, -0.3, 1.0)
    straight = servo_feedback(truck.now, 0.0, 0.0)
    truck.reckoning.observe_steering(straight.model_copy(update={"trusted": False}))
    assert truck.estimate.twist[2] > 0.1
    truck.reckoning.observe_steering(straight)
    assert truck.estimate.twist[2] == pytest.approx(0.0, abs=1e-9)
    unheard = Truck()
    unheard.reckoning.observe_steering(straight.model_copy(update={"trusted": False}))
    assert unheard.estimate.sources == ("drive",)


# Service


class Inbox:
    latest = None
    drops = 0


class Outbox(list):
    def next_seq(self):
        return len(self)

    def put(self, message):
        self.append(message)


def test_poses_go_out_50_times_a_second_in_odom_and_map():
    odometry, pose = Outbox(), Outbox()

    async def main(clock):
        truck = Truck()
        truck.reckoning._wheels._turns = None
        drive, steering, compass = Inbox(), Inbox(), Inbox()
        service = OdometryService(
            truck.reckoning, clock, drives=[drive], steering=steering, compass=compass, odometry=odometry, pose=pose
        )
        task = asyncio.create_task(service.run(lambda: None))
        await clock.sleep(0.2)
        assert odometry == []
        start = clock.now()
        while clock.now() - start < 2 * SECOND:
            now = clock.now()
            way = 0.2 * (now - start) / SECOND
            steering.latest = servo_feedback(now, 0.0, 0.0)
            drive.latest = drive_feedback(now, DRIVETRAIN.motor_angle(way))
            compass.latest = heading(now, 0.3)
            await clock.sleep(0.05)
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)

    run_virtual(main)
    assert len(odometry) == len(pose) == pytest.approx(100, abs=2)
    stamps = np.array([message.stamp for message in odometry])
    assert np.abs(np.diff(stamps) - SECOND // 50).max() < 1000
    assert {message.frame for message in odometry} == {"odom"}
    assert {message.frame for message in pose} == {"map"}
    assert pose[-1].pose == odometry[-1].pose
    assert odometry[-1].pose.x == pytest.approx(0.4, abs=0.015)
    assert odometry[-1].twist.vx == pytest.approx(0.2, rel=1e-3)
    assert {message.seq for message in odometry} == set(range(len(odometry)))
    assert max(message.age for message in odometry) < 0.06
    assert odometry[-1].sources == ("drive", "steering", "compass")


def test_a_truck_without_a_compass_publishes_too():
    odometry = Outbox()

    async def main(clock):
        drive, steering = Inbox(), Inbox()
        service = OdometryService(
            Truck(compass=None).reckoning,
            clock,
            drives=[drive],
            steering=steering,
            compass=None,
            odometry=odometry,
            pose=Outbox(),
        )
        task = asyncio.create_task(service.run(lambda: None))
        await clock.sleep(0.1)
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)

    run_virtual(main)
    assert odometry


NUMBER = st.floats(-3.0, 3.0)
ROOT = st.lists(NUMBER, min_size=9, max_size=9).map(lambda numbers: np.reshape(numbers, (3, 3)))


def covariance_of(matrix):
    return PlanarCovariance(matrix[0, 0], matrix[0, 1], matrix[1, 1], matrix[0, 2], matrix[1, 2], matrix[2, 2])


def full(found):
    return np.reshape(found.matrix(), (3, 3))


@given(root=ROOT, other=ROOT)
def test_it_stands_for_a_symmetric_matrix_and_adds_like_one(root, other):
    one, two = root @ root.T, other @ other.T
    np.testing.assert_array_equal(full(covariance_of(one)), full(covariance_of(one)).T)
    np.testing.assert_allclose(full(covariance_of(one).plus(covariance_of(two))), one + two, atol=1e-12)


@given(root=ROOT, dx=NUMBER, dy=NUMBER)
def test_a_way_swings_it_with_the_yaw(root, dx, dy):
    covariance = root @ root.T
    by_pose = np.array([[1.0, 0.0, -dy], [0.0, 1.0, dx], [0.0, 0.0, 1.0]])
    np.testing.assert_allclose(
        full(covariance_of(covariance).moved(dx, dy)), by_pose @ covariance @ by_pose.T, atol=1e-9
    )


@given(root=ROOT, noise=st.floats(0.1, 3.0))
def test_a_yaw_corrects_it_as_in_kalmans_filter(root, noise):
    covariance = root @ root.T
    gain = covariance[:, 2] / (covariance[2, 2] + noise)
    expected = (np.eye(3) - np.outer(gain, [0.0, 0.0, 1.0])) @ covariance
    np.testing.assert_allclose(full(covariance_of(covariance).corrected(*gain)), expected, atol=1e-9)
