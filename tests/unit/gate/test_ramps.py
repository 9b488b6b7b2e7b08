"""The ramps of wall following pass the gate of the robot with sonars as they are."""

from pathlib import Path

import pytest

from monstertruck_kinematics.profiles import CubicRamp
from monstertruckd.gate.config import InForce
from monstertruckd.gate.motion import Motion
from monstertruckd.tools.simulation.config import load_robot

FILE = Path(__file__).resolve().parents[3] / "configs" / "robots" / "sonar.yaml"
UP, DOWN, FLAT = CubicRamp(0.0, 0.2, 0.5), CubicRamp(0.2, 0.0, 0.5), CubicRamp(0.2, 0.2, 0.5)


def clipped(config, chassis, *moves):
    """Whether any tick's twist is another one than the ramps'; ``moves``: ramp of speed, ramp of yaw rate, its sign."""
    motion = Motion(InForce(config), chassis)
    for speed, yaw, sign in moves:
        for tick in range(1, round(0.5 * config.rate) + 1):
            wanted = speed.speed(tick / config.rate), 0.0, sign * yaw.speed(tick / config.rate)
            motion.accelerate(wanted, 1 / config.rate)
            if motion.twist != pytest.approx(wanted, abs=1e-9):
                return True
    return False


@pytest.mark.parametrize("sign", [1, -1])
def test_no_ramp_is_clipped(sign):
    robot = load_robot(FILE)[0]
    moves = (UP, UP, sign), (FLAT, DOWN, sign), (FLAT, UP, -sign), (DOWN, FLAT, -sign)
    assert not clipped(robot.gate, robot.chassis(), *moves)
    assert robot.gate.acceleration > 0.6
    assert robot.gate.yaw_acceleration > 0.6


@pytest.mark.parametrize("limit", ["acceleration", "yaw_acceleration"])
def test_limits_below_the_ramps_clip_them(limit):
    robot = load_robot(FILE)[0]
    assert clipped(robot.gate.model_copy(update={limit: 0.5}), robot.chassis(), (UP, UP, 1))
