"""What is reported of learnt errors of the axles: which, how much, and whether servo or slip."""

import math

import numpy as np
import pytest

from monstertruck_planners.collision import Footprint
from monstertruck_planners.track.axle_errors import AxleError, AxleErrorEstimator, AxleErrors
from monstertruck_planners.track.axle_report import report
from monstertruck_planners.track.service import Newest, TrackingStep, TrackSetup
from monstertruck_schemas.base import Pose2D, Twist2D
from monstertruck_schemas.event import Severity
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.state import GateMode, GateState, Odometry
from tests.unit.planners.kit import STEERING, Follower, figure_eight, path
from tests.unit.planners.track.test_axle_errors import driven

FRONT, COUNTER = (1.0, 0.0), (1.0, -1.0)


def reported(errors, speeds=(0.3,), **more):
    return report(driven(errors, speeds, noise=0.001, **more), STEERING.wheelbase)


def test_the_axle_is_named_with_its_gain_and_trim():
    found = reported(AxleErrors(AxleError(0.9, math.radians(2.8))), steering=FRONT)
    assert found.text == "front steers 10 % less than calibrated, 2.8 degrees to the left: `calibrate steering`"
    assert [row.servo_differs for row in found.axles] == [True, False]
    assert not found.agrees


@pytest.mark.parametrize(("trim", "side"), [(0.04, "left"), (-0.04, "right")])
def test_an_axle_out_of_trim_alone_is_named_with_the_side(trim, side):
    found = reported(AxleErrors(rear=AxleError(trim=trim)))
    assert found.text == f"rear steers 2.3 degrees to the {side}: `calibrate steering`"


def test_at_one_speed_neither_servo_nor_slip_is_blamed_and_no_calibration_advised():
    for wrong in (AxleError(0.85), AxleError(compliance=0.04)):
        found = reported(AxleErrors(wrong), (1.2,), steering=FRONT)
        assert "% less than calibrated at 1." in found.text
        assert "by its servo or by slip" in found.text
        assert "`calibrate" not in found.text
        assert not any(row.servo_differs for row in found.axles)


def test_another_speed_tells_slip_from_the_servo():
    slip = reported(AxleErrors(AxleError(compliance=0.03), AxleError(compliance=0.03)), (0.3, 1.2), steering=FRONT)
    assert slip.text.startswith("front steers 1.7 degrees less for each m/s^2 of lateral acceleration, by slip")
    assert not any(row.servo_differs for row in slip.axles)
    servo = reported(AxleErrors(AxleError(0.85)), (0.3, 1.2), steering=FRONT)
    assert servo.text == "front steers 15 % less than calibrated: `calibrate steering`"


def test_axles_that_only_the_turn_shows_are_named_together():
    wrong = AxleErrors(AxleError(0.9), AxleError(0.9))
    found = reported(wrong, located=False, compass=True, steering=COUNTER)
    assert found.text == "both axles steer 10 % less than calibrated: `calibrate steering`"
    assert [row.servo_differs for row in found.axles] == [True, True]
    assert not found.agrees


@pytest.mark.parametrize("seed", range(50))
def test_nothing_is_reported_of_a_truck_as_calibrated(seed):
    speeds, texts = np.random.default_rng(seed).uniform(0.2, 1.2, 2), set()
    driven(
        AxleErrors(), speeds, 15.0, noise=0.003, seed=seed,
        each=lambda estimator: texts.add(report(estimator, STEERING.wheelbase).text),
    )  # fmt: skip
    assert texts == {""}


def test_a_calibrated_truck_that_was_not_driven_agrees():
    assert report(AxleErrorEstimator(STEERING), STEERING.wheelbase).agrees


@pytest.mark.parametrize(("gain", "severities"), [(1.0, []), (0.85, [Severity.INFO, Severity.WARNING])])
def test_the_step_reports_once_that_something_differs_and_once_that_it_is_the_servo(gain, severities):
    course = path(figure_eight(1.5), closed=True)
    truck = Follower(course, pose=(0.0, 0.0, 0.8), kind="lqr", speed=0.5, dead_time=0.0)
    step = TrackingStep(TrackSetup(truck.config, STEERING, Footprint(), (0.14, 0.0, 0.0), located=True))
    pose, events, output = truck.pose, [], None
    for k in range(400):
        now = 10**9 + k * 50_000_000
        stamp = {"stamp": now, "received": now, "seq": k}
        at = Odometry(
            **stamp, frame="odom", pose=Pose2D(x=pose[0], y=pose[1], yaw=pose[2]),
            twist=Twist2D(vx=0.3, vy=0.0, wz=0.0), pose_covariance=np.zeros(9), twist_covariance=np.zeros(9), age=0.0,
            sources=(),
        )  # fmt: skip
        gate = GateState(**stamp, mode=GateMode.DRIVING, nonce="n", holder="tracker", speed_limit=1.0)
        output = step.step(now, Newest(at, course, gate))
        events += [event for event in output.events if event.reason is not Reason.DRIVING]
        wheels = gain * output.command.front, output.command.rear
        pose = STEERING.integrate(pose, *STEERING.body_twist(0.3, *wheels), 0.05)
    assert [event.severity for event in events] == severities
    assert {event.reason for event in events} <= {Reason.STEERING_DIFFERS}
    if events:
        assert "by its servo or by slip" in events[0].text
        assert events[-1].values["front_gain"] == pytest.approx(0.85, abs=0.04)
        assert output.steering.text.startswith("front steers 1")
