"""What tells that something holds a robot that drives into unseen ground, and how it leaves it."""

import math
import random
from functools import partial

import pytest

from monstertruck_runtime.clock import SECOND
from monstertruck_schemas import topics
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import Order, Role
from monstertruck_schemas.sensor import Imu, Vector3, WheelEncoders
from monstertruck_schemas.state import Consistency, StandingBody
from monstertruckd.gate.config import ContactConfig, GateConfig, weakened
from monstertruckd.gate.contact import ContactCheck, Lasting
from tests.unit.gate.rig import DRIVETRAIN, Rig, check_of, header

ROLLING, PUSHING = 0.15, 0.54


class Backing(Rig):
    """A truck that an operator backs into unseen ground; its drive measures currents."""

    def __init__(self, **config):
        super().__init__(**config)
        self.armed()
        self.load = ROLLING
        self.driver = {"speed": -0.15, "unseen": True}
        self.extra = lambda: None
        sense = self.sense

        def measured():
            self.current = math.copysign(self.load, self.speed) if self.speed else 0.0
            sense()
            self.extra()

        self.sense = measured

    def until(self, reason, ticks=100):
        """Seconds until a reason is given; None: it is not."""
        for tick in range(ticks):
            self.tick()
            if reason in self.out.reasons:
                return tick / 50
        return None


def backing(**config):
    rig = Backing(**config)
    rig.tick(50)
    assert rig.out.reasons == (Reason.UNSEEN_DRIVE,)
    assert rig.speed == pytest.approx(-0.05)
    return rig


def test_a_motor_that_pushes_is_noticed_within_three_tenths_of_a_second_and_backed_off_from():
    rig = backing()
    rig.load = PUSHING
    assert rig.until(Reason.CONTACT) <= 0.3
    assert rig.trips[-1].reason is Reason.CONTACT
    (figure,) = rig.trips[-1].causes[0].measurements
    assert (figure.name, figure.value, figure.unit) == ("motor current", pytest.approx(PUSHING), "A")
    assert figure.limit == pytest.approx(ROLLING * (1.0 + ContactConfig().rise))
    rig.load, before = ROLLING, rig.travelled
    rig.tick(20)
    assert rig.out.speeds[0] == pytest.approx(0.05), "the other way"
    rig.tick(60)
    assert rig.out.speeds[0] == 0.0
    assert rig.travelled - before == pytest.approx(ContactConfig().back_off, abs=0.01)
    rig.tick(100)
    assert rig.out.speeds[0] == 0.0, "until the operator asks for something else"
    assert Reason.CONTACT in rig.out.reasons


@pytest.mark.parametrize("asked", [0.0, 0.1])
def test_an_operator_who_lets_go_or_drives_away_decides_again(asked):
    rig = backing()
    rig.load = PUSHING
    rig.until(Reason.CONTACT)
    rig.load = ROLLING
    rig.driver = {"speed": asked, "unseen": True}
    rig.tick(40)
    assert rig.out.speeds[0] == pytest.approx(asked)
    rig.driver = {"speed": -0.15, "unseen": True}
    rig.tick(60)
    assert rig.out.speeds[0] == pytest.approx(-0.05)
    rig.load = PUSHING
    assert rig.until(Reason.CONTACT) is not None, "and it is noticed again"


def test_an_operator_who_already_drives_away_is_not_sent_back():
    rig = backing()
    rig.driver = {"speed": 0.1, "unseen": True}
    rig.tick()
    rig.load = PUSHING
    rig.tick()
    rig.load = ROLLING
    rig.tick(40)
    assert rig.out.speeds[0] == pytest.approx(0.1)


def test_a_drive_that_is_switched_on_while_it_accelerates_is_not_taken_for_a_contact():
    rig = Backing()
    rig.load = PUSHING
    obey, held = rig._obey, 25

    def late():
        nonlocal held
        held -= 1
        if held < 0:
            obey()
            rig.load = PUSHING if abs(rig.speed) < 0.04 else ROLLING

    rig._obey = late
    rig.tick(100)
    assert rig.out.reasons == (Reason.UNSEEN_DRIVE,)


def test_the_current_of_rolling_is_learned():
    rig = Backing(contact={"rolling": 0.6})
    rig.load = 0.5  # a stiff robot
    rig.tick(100)
    assert rig.out.reasons == (Reason.UNSEEN_DRIVE,)
    rig.load = 0.5 * (1.0 + ContactConfig().rise) - 0.02
    rig.tick()
    assert rig.out.reasons == (Reason.UNSEEN_DRIVE,)
    rig.load = 0.5 * (1.0 + ContactConfig().rise) + 0.1
    assert rig.until(Reason.CONTACT) is not None


def test_before_the_current_of_rolling_is_known_a_setting_stands_for_it():
    rig = Backing()
    rig.load = PUSHING
    assert rig.until(Reason.CONTACT) is not None


def test_a_motor_that_stalls_is_noticed():
    rig = backing()
    rig._obey = lambda: None
    rig.load, rig.speed = ROLLING, 0.0
    assert rig.until(Reason.CONTACT) <= 0.3
    (figure,) = check_of(rig.gate, ContactCheck).figures(Reason.CONTACT, rig.now)
    assert (figure.name, figure.value) == ("speed of shaft 0", 0.0)


def test_a_truck_that_cannot_back_off_gives_up():
    rig = backing(blocked=None)
    rig.load = PUSHING
    rig.until(Reason.CONTACT)
    rig._obey = lambda: None
    rig.load, rig.speed = ROLLING, 0.0
    rig.tick(40)
    assert rig.out.speeds[0] == pytest.approx(0.05)
    rig.tick(40)
    assert rig.out.speeds[0] == 0.0


def test_the_distance_backed_off_does_not_count_the_way_to_a_stop():
    rig = Backing(deceleration=0.5)
    rig.driver = {"speed": 0.2, "unseen": True}
    rig.tick(60)
    rig.load, before = PUSHING, rig.travelled
    rig.until(Reason.CONTACT)
    rig.load = ROLLING
    rig.tick(150)
    stopping = 0.2**2 / 2 / 0.5
    assert rig.travelled - before == pytest.approx(stopping + ContactConfig().back_off, abs=0.012)


def test_an_operator_who_was_gone_may_drive_there_again():
    rig = backing()
    rig.load = PUSHING
    rig.until(Reason.CONTACT)
    rig.load, driver, rig.driver = ROLLING, rig.driver, None
    rig.tick(60)
    rig.order(Order.ARM)
    rig.driver = driver
    rig.tick(60)
    assert rig.out.speeds[0] == pytest.approx(-0.05)


def test_only_an_operator_who_holds_the_second_control_is_backed_off():
    rig = Backing(obstacle={"unseen": "slow"})
    rig.driver = {"speed": -0.15}
    rig.tick(50)
    rig.load = PUSHING
    assert rig.until(Reason.CONTACT) is None


def standing(rig, since):
    """The scans show since ``since`` s ago that the body stands."""
    body = StandingBody(since=rig.now - round(since * SECOND), stamp=rig.now, rolled=0.02, shown=0.001)
    rig.gate.observe(Consistency(**header(rig.now), measures=("wheels",), standing=body), topics.CONSISTENCY)


def test_scans_that_show_a_standing_body_while_its_wheels_roll_are_noticed():
    rig = backing()
    standing(rig, 0.3)
    rig.tick()
    assert Reason.CONTACT in rig.out.reasons
    (figure,) = check_of(rig.gate, ContactCheck).figures(Reason.CONTACT, rig.now)
    assert (figure.name, figure.value, figure.unit) == ("distance by the scans", 0.001, "m")
    assert figure.limit == pytest.approx(0.02 * ContactConfig().share)


def test_a_body_that_stood_before_its_wheels_rolled_as_commanded_is_no_contact():
    rig = backing()
    standing(rig, 30.0)
    rig.tick()
    assert Reason.CONTACT not in rig.out.reasons
    rig.gate.observe(Consistency(**header(rig.now), measures=("wheels",)), topics.CONSISTENCY)
    rig.tick()
    assert Reason.CONTACT not in rig.out.reasons


@pytest.mark.parametrize("planner", [False, True])
def test_without_a_lidar_an_operator_is_backed_off_everywhere(planner):
    rig = Backing(scan={"stale_after": 0.25, "critical": False})
    rig.silent = {"scan"}
    rig.driver = {"speed": 0.15, "inside": True, "role": Role.TRACKER} if planner else {"speed": 0.15}
    rig.tick(60)
    assert rig.speed == pytest.approx(0.15)
    rig.load = PUSHING
    assert (rig.until(Reason.CONTACT) is None) is planner


def test_free_wheels_that_stand_are_noticed():
    rig = backing()
    angle = [0.0]

    def encoders():
        rig.gate.observe(WheelEncoders(**header(rig.now), left=angle[0], right=angle[0]), topics.ENCODERS)

    rig.extra = encoders
    for _ in range(50):
        angle[0] += rig.speed * 0.02 / rig.gate._chassis.drivetrain.wheel_radius
        rig.tick()
    assert rig.out.reasons == (Reason.UNSEEN_DRIVE,)
    assert rig.until(Reason.CONTACT) <= 0.3
    assert rig.trips[-1].causes[0].measurements[0].name == "speed of free wheels"


def test_a_body_that_does_not_turn_is_noticed():
    rig = Backing()
    rig.driver = {"speed": -0.15, "front": 0.4, "rear": -0.4, "unseen": True}
    turning = [True]

    def gyro():
        rate = rig.out.twist[2] if rig.out and turning[0] else 0.0
        zero = Vector3(x=0.0, y=0.0, z=0.0)
        imu = Imu(**header(rig.now), angular_velocity=Vector3(x=0.0, y=0.0, z=rate), linear_acceleration=zero)
        rig.gate.observe(imu, topics.IMU)

    rig.extra = gyro
    rig.tick(100)
    assert Reason.CONTACT not in rig.out.reasons
    assert abs(rig.out.twist[2]) > 0.1
    turning[0] = False
    assert rig.until(Reason.CONTACT) <= 0.3
    assert rig.trips[-1].causes[0].measurements[0].name == "speed of body"


@pytest.mark.parametrize(("angle", "obeys"), [(0.03, True), (0.4, False)])
def test_a_slow_turn_and_one_that_has_not_begun_show_nothing_by_the_gyroscope(angle, obeys):
    """Its bias is as large as the one; the other is what the motor has not done yet."""
    rig = Backing(blocked=None)
    rig.driver = {"speed": -0.15, "front": angle, "rear": -angle, "unseen": True}
    if not obeys:
        rig._obey = lambda: None

    def gyro():
        zero = Vector3(x=0.0, y=0.0, z=0.0)
        rig.gate.observe(Imu(**header(rig.now), angular_velocity=zero, linear_acceleration=zero), topics.IMU)

    rig.extra = gyro
    assert rig.until(Reason.CONTACT) is None
    assert abs(rig.out.twist[2]) > 0.005


def test_a_condition_lasts_from_the_first_message_that_shows_it():
    lasting, step = Lasting(), SECOND // 20
    shown = [lasting.holds(9 * SECOND + k * step, 0.15, true=k != 5) for k in range(10)]
    assert shown == [False, False, False, True, True, False, False, False, False, True]


@pytest.mark.parametrize("driver", [{"vx": -0.15, "unseen": True}, (-0.15 / DRIVETRAIN.wheel_radius,)])
def test_it_backs_off_in_every_form_of_request(driver):
    rig = Backing()
    rig.roll = partial(rig.roll, unseen=True)
    rig.driver = driver
    rig.tick(60)
    assert rig.out.reasons[:1] == (Reason.UNSEEN_DRIVE,)
    rig.load = PUSHING
    assert rig.until(Reason.CONTACT) is not None
    rig.load = ROLLING
    rig.tick(15)
    assert rig.out.speeds == pytest.approx((0.05,))


def test_without_the_check_nothing_is_noticed_and_the_robot_says_so():
    rig = backing(contact=None)
    rig.load = PUSHING
    assert rig.until(Reason.CONTACT) is None
    assert "gate.contact null: a contact in unseen ground is not noticed" in weakened(GateConfig(contact=None))


def test_without_a_lidar_a_motor_that_draws_more_than_assumed_is_measured_first():
    rig = Backing(scan={"stale_after": 0.25, "critical": False})
    rig.silent = {"scan"}
    rig.driver, rig.load = {"speed": 0.15}, 1.0
    assert rig.until(Reason.CONTACT) is None
    rig.load = 2.2
    assert rig.until(Reason.CONTACT) is not None


def test_a_small_motor_that_pushes_draws_less_than_a_large_one_that_rolls():
    rig = Backing(scan={"stale_after": 0.25, "critical": False})
    rig.silent = {"scan"}
    rig.driver, rig.load = {"speed": 0.15}, 0.03
    assert rig.until(Reason.CONTACT) is None
    rig.load = 0.1
    assert rig.until(Reason.CONTACT) is not None


@pytest.mark.parametrize("load", [0.0, -0.1])
def test_the_noise_of_a_motor_that_hardly_draws_current_is_no_contact(load):
    """A motor that rolls downhill, or whose current is as small as its noise."""
    rig = Backing(scan={"stale_after": 0.25, "critical": False})
    rng = random.Random(1)
    rig.silent = {"scan"}
    rig.driver = {"speed": 0.15}

    def noisy():
        rig.load = load + rng.gauss(0.0, 0.02)

    rig.extra = noisy
    assert rig.until(Reason.CONTACT, ticks=500) is None
    rig.extra = lambda: None
    rig.load = 0.3
    assert rig.until(Reason.CONTACT) is not None


@pytest.mark.parametrize(("usual", "noise"), [(0.0, 0.0), (0.0, 0.004), (0.02, 0.004)])
@pytest.mark.parametrize("seed", range(3))
def test_a_step_of_a_rounded_current_is_no_contact(usual, noise, seed):
    """The drive reports multiples of 10 mA, which hide noise below half of that."""
    rig = Backing(scan={"stale_after": 0.25, "critical": False})
    rig.silent, rig.driver, rng = {"scan"}, {"speed": 0.15}, random.Random(seed)

    def rounded():
        rig.load = round((usual + rng.gauss(0.0, noise)) / 0.01) * 0.01

    rig.extra = rounded
    assert rig.until(Reason.CONTACT, ticks=200) is None
    usual += 0.006
    assert rig.until(Reason.CONTACT, ticks=800) is None
    rig.extra, rig.load = lambda: None, 0.1
    assert rig.until(Reason.CONTACT) is not None


def test_a_motor_whose_current_reads_zero_measures_none():
    """The other measures still show a contact."""
    rig = Backing(scan={"stale_after": 0.25, "critical": False})
    rig.silent, rig.driver, rig.load = {"scan"}, {"speed": 0.15}, 0.0
    assert rig.until(Reason.CONTACT, ticks=200) is None
    rig.load = 0.5
    assert rig.until(Reason.CONTACT, ticks=50) is None
    rig._obey = lambda: None
    rig.load, rig.speed = 0.0, 0.0
    assert rig.until(Reason.CONTACT) <= 0.3
