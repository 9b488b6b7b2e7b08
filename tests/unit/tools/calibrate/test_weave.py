"""Dead time and lag from a weaving truck."""

import math
from collections import deque

import numpy as np
import pytest

from monstertruck_kinematics.chassis import Dimensions
from monstertruck_kinematics.truck import DriveTrain
from monstertruck_runtime.bodies import build_chassis
from monstertruck_runtime.clock import SECOND
from monstertruck_runtime.errors import InputError
from monstertruck_schemas.body import TruckBody
from monstertruck_schemas.cmd import SteeringCommand
from monstertruck_schemas.sensor import Attitude, DriveFeedback, DriveMode
from monstertruckd.tools.calibrate.response import ANGLE, SPEED, WEAVE, estimates, response, weaves
from monstertruckd.tools.calibrate.steps import MoveRecord

CHASSIS = build_chassis(TruckBody(), Dimensions(DriveTrain(644.0, 0.075), 0.32, 0.26))
MOTOR = SPEED / 0.075 * 644.0
"""rad/s."""


def record(dead_time, lag, direction=1, gain=0.9, seconds=12.0, noise=0.002, seed=1):
    """What is read of a truck that weaves; commands are ramped as the gate does."""
    rng = np.random.default_rng(seed)
    found, waiting = MoveRecord(), deque([0.0] * round(dead_time / 0.01))
    command = angle = yaw = 0.0
    for k in range(round(seconds / 0.01)):
        t = round((1.0 + k * 0.01) * SECOND)
        header = {"stamp": t, "received": t, "seq": k}
        if k % 2 == 0:
            wanted = ANGLE if int(k * 0.01 / WEAVE) % 2 == 0 else -ANGLE
            command += min(max(wanted - command, -0.02), 0.02)
            found.commands.append(
                SteeringCommand(**header, front=command, rear=-command, front_servo=0.0, rear_servo=0.0)
            )
        if k % 5 == 0:
            heading = (-yaw + noise * rng.standard_normal()) % math.tau
            found.attitude.append(Attitude(**header, heading=heading, roll=0.0, pitch=0.0))
            found.drive.append(
                DriveFeedback(
                    **header, position=direction * MOTOR * 0.01 * k, velocity=direction * MOTOR, mode=DriveMode.ENABLED
                )
            )
        waiting.append(command)
        angle += (1.0 if lag == 0.0 else -math.expm1(-0.01 / lag)) * (waiting.popleft() - angle)
        yaw += 0.01 * gain * CHASSIS.bicycle.body_twist(direction * SPEED, angle, -angle)[2]
    return found


@pytest.mark.parametrize(("dead_time", "lag"), [(0.0, 0.0), (0.02, 0.06), (0.12, 0.05)])
def test_their_sum_is_known_to_ten_milliseconds(dead_time, lag):
    records = [record(dead_time, lag, sign, seed=seed) for seed in (1, 2, 3) for sign in (1, -1)]
    by_name = {estimate.name: estimate for estimate in estimates(response(records, CHASSIS))}
    delay = by_name["delay"]
    # What is commanded acts for a tick of the gate before the next one: half a tick more.
    assert delay.low - 0.005 <= dead_time + lag <= delay.high + 0.005
    assert (delay.high - delay.low) / 2 < 0.010
    assert by_name["dead_time"].low <= dead_time <= by_name["dead_time"].high
    assert by_name["lag"].low <= lag <= by_name["lag"].high
    assert delay.key is None
    assert by_name["lag"].key == "devices.steering.driver.lag"


def test_a_truck_that_does_not_turn_is_refused():
    with pytest.raises(InputError, match="only 0 turns"):
        response([record(0.0, 0.0, seconds=0.2), MoveRecord()], CHASSIS)


def test_it_weaves_ahead_and_back():
    assert [move.speed for move in weaves(2)] == [SPEED, -SPEED, SPEED, -SPEED]
    assert all(move.weave == WEAVE for move in weaves(1))
