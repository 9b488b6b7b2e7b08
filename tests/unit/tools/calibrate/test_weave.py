"""Dead time and lag from a weaving truck."""

import math
from collections import deque
from dataclasses import replace

import numpy as np
import pytest

from monstertruck_drivers.os4000.attitude import level_field
from monstertruck_drivers.os4000.config import IronConfig
from monstertruck_kinematics.chassis import Dimensions
from monstertruck_kinematics.truck import DriveTrain
from monstertruck_runtime.bodies import build_chassis
from monstertruck_runtime.clock import SECOND
from monstertruck_runtime.errors import InputError
from monstertruck_schemas.body import TruckBody
from monstertruck_schemas.cmd import SteeringCommand
from monstertruck_schemas.sensor import STANDARD_GRAVITY, Attitude, DriveFeedback, DriveMode, Vector3
from monstertruckd.tools.calibrate.assumed import ASSUMED
from monstertruckd.tools.calibrate.steps import MoveRecord, MoveStep
from monstertruckd.tools.calibrate.weave import ANGLE, estimates, response, weaves
from tests.long_kit import mostly_long

SPEED = 0.15

WEAVE = (0.3, 0.3, 0.3, 0.3, 1.2)

CHASSIS = build_chassis(TruckBody(), Dimensions(DriveTrain(644.0, 0.075), 0.32, 0.26))
STEP = 0.001
"""s."""
MOTOR = SPEED / 0.075 * 644.0
"""rad/s."""
IRON = IronConfig(hard_x=3.0, hard_y=-2.0)


def felt(header, heading, roll):
    """A reading of a level unit with iron that takes what it feels for tilt, and levels its field by that."""
    field = (25.0 * math.cos(heading) + 3.0, 25.0 * math.sin(heading) - 2.0, -39.0)
    forward, left = level_field(field, 0.0, roll, IRON)
    return Attitude(
        **header, heading=math.atan2(left, forward) % math.tau, roll=roll, pitch=0.0,
        magnetic_field=Vector3(**dict(zip("xyz", field, strict=True))),
    )  # fmt: skip


def record(dead_time, lag, direction=1, gain=0.9, seconds=12.0, noise=0.002, seed=1, field=False):
    """What is read of a truck that weaves northwards; commands are ramped as the gate does."""
    rng = np.random.default_rng(seed)
    found, waiting = MoveRecord(), deque([0.0] * round(dead_time / STEP))
    move, command, angle, yaw, rate = weaves(1)[0], 0.0, 0.0, 0.0, 0.0
    for k in range(round(seconds / STEP)):
        t = round((1.0 + k * STEP) * SECOND)
        header = {"stamp": t, "received": t, "seq": k}
        if k % 20 == 0:
            wanted = move.side(k * STEP) * ANGLE
            command += min(max(wanted - command, -0.02), 0.02)
            found.steering_commands.append(
                SteeringCommand(**header, front=command, rear=-command, front_servo=0.0, rear_servo=0.0)
            )
        if k % 50 == 0:
            heading = (-yaw + noise * rng.standard_normal()) % math.tau
            roll = direction * SPEED * rate / STANDARD_GRAVITY
            found.attitude.append(
                felt(header, heading, roll) if field else Attitude(**header, heading=heading, roll=roll, pitch=0.0)
            )
            found.drive.append(
                DriveFeedback(
                    **header, position=direction * MOTOR * STEP * k, velocity=direction * MOTOR, mode=DriveMode.ENABLED
                )
            )
        waiting.append(command)
        before = angle
        angle += (1.0 if lag == 0.0 else -math.expm1(-STEP / lag)) * (waiting.popleft() - angle)
        middle = 0.5 * (before + angle) if lag else angle
        rate = gain * CHASSIS.bicycle.body_twist(direction * SPEED, middle, -middle)[2]
        yaw += STEP * rate
    return found


@pytest.mark.parametrize(
    ("dead_time", "lag"),
    mostly_long([(0.0, 0.0), (0.02, 0.06), (0.042, 0.013), (0.093, 0.031), (0.12, 0.05)], {(0.0, 0.0), (0.093, 0.031)}),
)
def test_dead_time_and_lag_lie_in_narrow_intervals(dead_time, lag):
    records = [record(dead_time, lag, sign, seed=k) for k in (1, 2, 3) for sign in (1, -1)]
    found = response(records, CHASSIS, IRON)
    assert found.delay.value == pytest.approx(dead_time + lag, abs=0.002)
    assert found.delay.half < ASSUMED.servo_wait + 0.002
    by_name = {estimate.name: estimate for estimate in estimates(found)}
    assert by_name["dead_time"].low <= dead_time <= by_name["dead_time"].high
    assert by_name["lag"].low <= lag <= by_name["lag"].high
    assert by_name["lag"].high - by_name["lag"].value < 0.025
    assert by_name["delay"].key is None
    assert by_name["lag"].key == "devices.steering.driver.lag"


def test_a_truck_that_does_not_turn_is_refused():
    with pytest.raises(InputError, match="only 0 turns"):
        response([record(0.0, 0.0, seconds=0.2), MoveRecord()], CHASSIS, IRON)


def test_what_the_compass_takes_for_tilt_in_turns_is_no_delay():
    ahead = [record(0.04, 0.04, seed=k, field=True) for k in (1, 2, 3)]
    found = response(ahead, CHASSIS, IRON)
    assert found.delay.value == pytest.approx(0.08, abs=0.003)
    assert found.squared.low <= 0.04**2 <= found.squared.high
    own = [
        replace(one, attitude=[r.model_copy(update={"magnetic_field": None}) for r in one.attitude]) for one in ahead
    ]
    assert abs(response(own, CHASSIS, IRON).delay.value - 0.08) > 0.015


def test_it_weaves_ahead_and_back():
    assert [move.speed for move in weaves(2)] == [SPEED, -SPEED, SPEED, -SPEED]
    assert all(move.weave == WEAVE for move in weaves(1))


def test_sides_change_in_turn_and_long_arcs_go_to_both():
    move = MoveStep("weaving", 0.1, weave=(0.25, 0.25, 1.0))
    assert [move.side(t) for t in (0.0, 0.2, 0.25, 0.5, 1.4, 1.5, 1.75, 2.0, 2.9, 3.0)] == [
        1, 1, -1, 1, 1, -1, 1, -1, -1, 1,
    ]  # fmt: skip
    assert MoveStep("straight", 0.1).side(5.0) == 1
