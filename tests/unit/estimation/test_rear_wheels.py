"""Odometry by a tricycle's rear wheels: what judges its encoders, what goes on without them."""

import math

import pytest

from monstertruck_estimation.rear_wheels import EncoderConfig, EncoderInput, RearWheelConfig, RearWheelReckoning, judged
from monstertruck_kinematics.chassis import Dimensions, tricycle_chassis
from monstertruck_kinematics.se2 import integrate
from monstertruck_runtime.clock import SECOND
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.sensor import SteeringFeedback, WheelEncoders
from tests.unit.estimation.kit import DRIVETRAIN, drive_feedback

CHASSIS = tricycle_chassis(Dimensions(DRIVETRAIN, 0.32, 0.26))
RADIUS = DRIVETRAIN.wheel_radius


class Tricycle:
    """Truth, motor at 20 Hz and encoders at 25 Hz, whose wheels do what ``share`` says of the true way."""

    def __init__(self):
        self.reckoning = RearWheelReckoning(RearWheelConfig(kind="encoders", compass=None), CHASSIS)
        self.events = []
        self.readings = []
        self.input = EncoderInput(self.reckoning, self, lambda reason, *a, **_: self.events.append((reason, a[2])), "o")
        self.now, self.pose, self.motor, self.angles = SECOND, (0.0, 0.0, 0.0), 0.0, [0.0, 0.0]
        self.share, self.grip, self.heard = [1.0, 1.0], 1.0, True
        self.observe()

    def drain(self):
        readings, self.readings = self.readings, []
        return readings

    def observe(self):
        if self.heard and self.now % (SECOND // 25) == 0:
            head = {"stamp": self.now, "received": self.now, "seq": 0, "frame": "encoders"}
            self.readings.append(WheelEncoders(**head, left=self.angles[0], right=self.angles[1]))
        self.input.take()
        if self.now % (SECOND // 20) == 0:
            self.reckoning.observe_drive(drive_feedback(self.now, self.motor))
        self.input.report()

    def drive(self, speed, front, seconds):
        """Speed of the front wheel's tread; ``grip`` of it moves the robot."""
        head = {"stamp": self.now, "received": self.now, "seq": 0}
        self.reckoning.observe_steering(SteeringFeedback(**head, front=front, rear=0.0))
        twist = CHASSIS.twist((self.grip * speed,), front, 0.0)
        ways = CHASSIS.rear_of_twist(twist)
        for _ in range(round(seconds * 100)):
            self.now += SECOND // 100
            self.pose = integrate(self.pose, *twist, 0.01)
            self.motor += speed * 0.01 / DRIVETRAIN.distance(1.0)
            self.angles = [a + s * w * 0.01 / RADIUS for a, s, w in zip(self.angles, self.share, ways, strict=True)]
            self.observe()

    def is_near(self, position, turn):
        """Whether the pose is the true one, within m and rad."""
        x, y, yaw = self.reckoning.estimate(self.now).pose
        off = math.hypot(x - self.pose[0], y - self.pose[1]), abs(math.remainder(yaw - self.pose[2], math.tau))
        return off[0] < position and off[1] < turn

    @property
    def sources(self):
        return self.reckoning.estimate(self.now).sources


def test_the_rear_wheels_carry_the_pose_without_the_steering_angle():
    truck = Tricycle()
    truck.drive(0.2, 0.0, 0.5)
    truck.reckoning._wheels._angles = (0.0, 0.0)
    for front in (0.4, -0.5):
        truck.drive(0.2, front, 4.0)
    assert truck.is_near(0.002, 0.002)
    assert truck.sources[:2] == ("encoders", "drive")
    assert truck.events == []


def test_a_driven_wheel_that_slips_leaves_the_pose_alone_and_is_named():
    truck = Tricycle()
    truck.drive(0.2, 0.3, 2.0)
    truck.grip = 0.5
    truck.drive(0.2, 0.3, 3.0)
    assert truck.is_near(0.005, 0.005)
    assert [reason for reason, _ in truck.events] == [Reason.WHEEL_SLIP]
    truck.grip = 1.0
    truck.drive(0.2, 0.3, 3.0)
    assert [reason for reason, _ in truck.events] == [Reason.WHEEL_SLIP, Reason.WHEEL_GRIP]


@pytest.mark.parametrize("side", [0, 1], ids=["left", "right"])
@pytest.mark.parametrize(
    ("share", "said"), [(0.0, "is stuck"), (-1.0, "counts in the wrong direction"), (0.6, "rolls 0.")]
)
def test_one_bad_encoder_is_named_taken_back_and_the_other_one_goes_on(side, share, said):
    truck = Tricycle()
    truck.drive(0.2, 0.2, 2.0)
    truck.share[side] = share
    truck.drive(0.2, 0.2, 4.0)
    ((reason, text),) = truck.events
    assert reason is Reason.ENCODERS_DISAGREE
    assert f"{('left', 'right')[side]} {said}" in text
    assert f"odometry uses {('right', 'left')[side]} and steering" in text
    assert truck.is_near(0.03, 0.03)
    assert truck.sources[0] == "encoders"
    truck.share[side] = 1.0
    truck.drive(0.2, 0.2, 4.0)
    assert truck.events[1][0] is Reason.ENCODERS_AGREE
    assert truck.is_near(0.04, 0.04)


@pytest.mark.parametrize(
    ("shares", "said"),
    [((0.0, 0.0), "left is stuck, right is stuck"), ((-1.0, -1.0), "wrong direction"), ((2.0, 2.0), "rolls")],
)
def test_without_both_the_drive_carries_on(shares, said):
    truck = Tricycle()
    truck.drive(0.2, 0.2, 2.0)
    truck.share = list(shares)
    truck.drive(-0.2, 0.2, 4.0)
    ((reason, text),) = truck.events
    assert reason is Reason.ENCODERS_DISAGREE
    assert said in text
    assert "odometry uses the drive" in text
    assert truck.is_near(0.04, 0.04)
    assert truck.sources == ("drive", "steering") or truck.sources == ("drive",)


def test_exchanged_encoders_show_in_a_turn():
    verdict = judged((0.2, 0.6), (0.6, 0.2), 0.4, 0.1, EncoderConfig())
    assert verdict.trusted == (False, False)
    assert "swapped" in verdict.text


def test_a_robot_that_turns_otherwise_than_steered_is_believed_and_said():
    verdict = judged((0.2, 0.6), (0.4, 0.4), 0.4, 0.1, EncoderConfig())
    assert verdict.trusted == (True, True)
    assert "does not turn as steered" in verdict.text
    assert not verdict.slips


def test_a_robot_that_is_pushed_slips():
    verdict = judged((0.0, 0.0), (0.3, 0.3), 0.0, 0.1, EncoderConfig())
    assert verdict.trusted == (True, True)
    assert verdict.slips
    assert judged((0.05, 0.05), (0.0, 0.0), 0.0, 0.1, EncoderConfig()) is None


def test_while_nothing_is_heard_the_drive_carries_on_and_no_way_is_lost_or_counted_twice():
    truck = Tricycle()
    truck.heard = False
    truck.drive(0.2, 0.3, 2.03)
    assert truck.sources[0] == "drive"
    truck.heard = True
    for _ in range(3):
        truck.drive(0.2, 0.3, 1.5)
        assert truck.sources[0] == "encoders"
        truck.heard = False
        truck.drive(0.2, 0.3, 1.03)
        assert truck.sources[0] == "drive"
        truck.angles = [0.0, 0.0]  # it was without supply
        truck.heard = True
    truck.drive(0.2, 0.3, 1.0)
    assert truck.is_near(0.01, 0.006)  # half a reading of the motor from one steering angle to the next
    assert truck.events == []


def test_a_motor_that_counts_anew_does_not_move_the_pose_nor_judge():
    truck = Tricycle()
    truck.drive(0.2, 0.2, 2.0)
    truck.motor = 0.0
    truck.drive(0.2, 0.2, 2.0)
    assert truck.is_near(0.002, 0.002)
    assert truck.events == []
