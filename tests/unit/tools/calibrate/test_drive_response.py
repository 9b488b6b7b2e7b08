"""Dead time and lag of the drive from runs that set off and stop."""

import math
from collections import deque

import pytest

from monstertruck_runtime.clock import SECOND
from monstertruck_runtime.errors import InputError
from monstertruck_schemas.cmd import DriveAction, DriveCommand
from monstertruck_schemas.sensor import DriveFeedback, DriveMode
from monstertruckd.tools.calibrate.drive import drive_estimates, drive_response
from monstertruckd.tools.calibrate.steps import MoveRecord

STEP = 0.001
"""s."""
CYCLE = 0.05
"""Of the driver, s."""
SPEED = 1290.0
"""rad/s."""


def run(starts: float, stops: float, lag: float, direction: int = 1) -> MoveRecord:
    """A motor that follows after ``starts`` s when its speed grows and ``stops`` s when it falls."""
    found = MoveRecord()
    command = speed = position = 0.0
    late = {+1: deque([0.0] * round(starts / STEP)), -1: deque([0.0] * round(stops / STEP))}
    for k in range(round(6.0 / STEP)):
        header = {"stamp": SECOND + k * 1_000_000, "received": SECOND + k * 1_000_000, "seq": k}
        if k % 20 == 0:
            wanted = SPEED if 1.0 <= k * STEP < 4.0 else 0.0
            command += min(max(wanted - command, -170.0), 85.0)
            found.drive_commands.append(
                DriveCommand(**header, action=DriveAction.RUN, speed=0.15, motor_velocity=direction * command)
            )
        if k % 50 == 0:
            found.drive.append(
                DriveFeedback(**header, position=direction * position, velocity=speed, mode=DriveMode.ENABLED)
            )
        for queue in late.values():
            queue.append(command)
        seen = {sign: queue.popleft() for sign, queue in late.items()}
        target = seen[+1] if k * STEP < 3.0 else seen[-1]
        before = speed
        speed += -math.expm1(-STEP / lag) * (target - speed)
        position += STEP * 0.5 * (before + speed)
    return found


def test_setting_off_and_stopping_are_kept_apart():
    runs = [run(0.06, 0.02, 0.03, sign) for sign in (1, -1)]
    for part, dead_time in (("start", 0.06), ("stop", 0.02)):
        found = drive_response(runs, part, CYCLE)
        assert found.delay.value == pytest.approx(dead_time + 0.03, abs=0.002)
        assert math.sqrt(found.squared.value) == pytest.approx(0.03, abs=0.003)
        assert 0.95 * CYCLE / 2 <= found.delay.half < CYCLE / 2 + 0.002
    estimates = drive_estimates(runs, 1 / CYCLE)
    assert [estimate.name for estimate in estimates] == [
        "start_dead_time", "start_lag", "start_delay", "stop_dead_time", "stop_lag", "stop_delay",
    ]  # fmt: skip
    assert {estimate.key for estimate in estimates} == {None}


def test_a_run_without_readings_is_refused():
    with pytest.raises(InputError, match="start: no run has 8 readings"):
        drive_estimates([MoveRecord()], 20.0)
