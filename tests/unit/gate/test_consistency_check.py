"""Sensors in doubt: what stops the robot, what slows it, and when that ends."""

import pytest

from monstertruck_planners.collision import Footprint
from monstertruck_runtime.clock import SECOND
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.state import Consistency, Doubt, DoubtKind, GateMode
from monstertruck_schemas.topics import CONSISTENCY
from monstertruckd.gate.arbitration import EventLog, GateStateMachine
from monstertruckd.gate.checks import GateView, Tick
from monstertruckd.gate.config import GateConfig, InForce, SensorLimit
from monstertruckd.gate.consistency import ConsistencyCheck
from monstertruckd.gate.motion import Motion
from monstertruckd.gate.samples import Samples
from tests.unit.gate.rig import CHASSIS, SERVICES

NOW = 100 * SECOND
AHEAD = [((1.0, 0.0, 0.0), 0.2)]
BACK = [((-1.0, 0.0, 0.0), 0.2)]


class Rig:
    """The check alone, before a gate in some mode."""

    def __init__(self, **config):
        limits = InForce(GateConfig(**config))
        self.states = GateStateMachine(EventLog(1.0), latched=False)
        samples, motion = Samples(limits, CHASSIS, SERVICES), Motion(limits, CHASSIS)
        self.check = ConsistencyCheck(GateView(limits, CHASSIS, Footprint(), samples, motion, self.states))

    def say(self, *doubts, measures=("wheels", "scans"), distances=None, at=NOW):
        known = {"measures": measures, "distances": distances, "doubts": doubts}
        message = Consistency(stamp=at, received=at, seq=0, frame="base", **known)
        self.check.observe(message, CONSISTENCY)

    def arm(self, at):
        self.check.observe(Tick(at - 1, SECOND // 50), None)
        self.states.mode = GateMode.ARMED

    def reasons(self):
        return tuple(self.check.reason(NOW))

    def limits(self, courses=AHEAD, at=NOW):
        return {limit.reason: limit.pace for limit in self.check.limit(at, courses)}


def doubt(sensor="lidar", kind=DoubtKind.MOTION, since=NOW):
    return Doubt(sensor=sensor, kind=kind, since=since, text="1 m apart", against="drive", difference=1.0, limit=0.2)


@pytest.mark.parametrize(("sensor", "key"), [("lidar", "scan"), ("compass", "attitude"), ("drive", "drive")])
def test_a_sensor_in_doubt_stops_the_robot_where_its_silence_would(sensor, key):
    rig = Rig()
    rig.arm(NOW - SECOND)
    rig.say(doubt(sensor))
    assert rig.reasons() == (Reason.SENSORS_DISAGREE,)
    (cause,) = rig.check.describe(Reason.SENSORS_DISAGREE, NOW, NOW)
    assert cause.source == sensor
    assert "1 m apart" in cause.text
    tolerant = Rig(**{key: SensorLimit(stale_after=0.2, critical=False)})
    tolerant.arm(NOW - SECOND)
    tolerant.say(doubt(sensor))
    assert tolerant.reasons() == ()


def test_a_robot_without_a_compass_does_not_stop_for_one():
    rig = Rig(attitude=None)
    rig.arm(NOW - SECOND)
    rig.say(doubt("compass"))
    assert rig.reasons() == ()


def test_sensors_that_the_gate_does_not_use_stop_nothing():
    rig = Rig()
    rig.arm(NOW - SECOND)
    rig.say(doubt("camera", DoubtKind.REPEATS), doubt("imu"), doubt("radar"))
    assert rig.reasons() == ()


def test_a_doubt_about_motion_from_before_arming_is_over():
    rig = Rig()
    rig.say(doubt(since=NOW - 2 * SECOND))
    assert rig.reasons() == ()
    rig.arm(NOW - SECOND)
    assert rig.reasons() == ()
    rig.say(doubt(since=NOW))
    assert rig.reasons() == (Reason.SENSORS_DISAGREE,)


def test_a_frozen_sensor_keeps_the_robot_from_being_armed():
    rig = Rig()
    rig.say(doubt(kind=DoubtKind.REPEATS, since=NOW - 2 * SECOND))
    assert rig.reasons() == (Reason.SENSOR_FROZEN,)
    rig.say()
    assert rig.reasons() == ()


def test_a_frozen_battery_voltage_slows_the_robot():
    rig = Rig()
    rig.say(doubt("battery", DoubtKind.REPEATS))
    assert rig.reasons() == ()
    assert rig.limits()[Reason.SENSOR_FROZEN] == GateConfig().battery_low_speed


def test_without_a_second_measure_the_speed_limits_are_halved():
    rig, config = Rig(), GateConfig()
    assert rig.limits() == {Reason.UNWITNESSED: config.speed / 2}
    rig.say(measures=("wheels",))
    assert rig.limits() == {Reason.UNWITNESSED: config.speed / 2}
    assert rig.limits(BACK) == {Reason.UNWITNESSED: config.reverse_speed / 2}
    assert rig.limits([]) == rig.limits(None) == {}
    rig.say()
    assert rig.limits() == {}
    assert rig.limits(at=NOW + 4 * SECOND) == {Reason.UNWITNESSED: config.speed / 2}


@pytest.mark.parametrize(
    ("measures", "distances", "text"),
    [
        (("wheels",), ("wheels",), "measures distance (a lidar or encoders of free wheels) and yaw (a compass, an IMU"),
        (("wheels", "gyro"), ("wheels",), "measures distance (a lidar or encoders of free wheels)"),
        (("wheels", "scans"), ("wheels", "scans"), "the comparison of sensors is silent"),
        (("wheels",), None, Reason.UNWITNESSED.text),
    ],
)
def test_it_says_what_the_robot_lacks(measures, distances, text):
    rig = Rig()
    rig.say(measures=measures, distances=distances)
    assert text in rig.check.text(Reason.UNWITNESSED)


def test_a_robot_armed_to_calibrate_is_slowed_by_measures_that_disagree_and_stopped_by_frozen_ones():
    rig = Rig(speed=0.2, unwitnessed=0.5)
    rig.arm(NOW - SECOND)
    rig.states.arm(NOW - SECOND, "ann", calibrates=True)
    rig.say(doubt("drive"))
    assert rig.reasons() == ()
    assert rig.limits() == {Reason.SENSORS_DISAGREE: pytest.approx(0.1)}
    rig.say(doubt("drive", DoubtKind.REPEATS))
    assert rig.reasons() == (Reason.SENSOR_FROZEN,)


def test_the_next_order_to_arm_ends_a_calibration():
    rig = Rig()
    rig.arm(NOW - SECOND)
    rig.states.arm(NOW - SECOND, "ann", calibrates=True)
    rig.states.arm(NOW - SECOND, "ann")
    rig.say(doubt("drive"))
    assert rig.reasons() == (Reason.SENSORS_DISAGREE,)
