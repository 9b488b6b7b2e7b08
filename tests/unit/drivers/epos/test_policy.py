"""What commands mean, and where the shaft is."""

import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError

from monstertruck_drivers.epos.config import EposConfig
from monstertruck_drivers.epos.driver import Odometer, Setpoint, drive_mode, setpoint_of, settled
from monstertruck_drivers.epos.exchange import ControllerIdentity
from monstertruck_drivers.epos.protocol import State
from monstertruck_runtime.clock import SECOND
from monstertruck_runtime.errors import DeviceMismatchError
from monstertruck_schemas.cmd import DriveAction, DriveCommand
from monstertruck_schemas.sensor import DriveMode

CONFIG = EposConfig()
OFF = Setpoint(State.SWITCH_ON_DISABLED)
STOP = Setpoint(State.QUICK_STOP)
FASTEST = 600_000.0


def command(action: DriveAction, rpm: float = 0.0) -> DriveCommand:
    velocity = rpm * 2 * math.pi / 60
    return DriveCommand(stamp=SECOND, received=SECOND, seq=0, action=action, speed=0.0, motor_velocity=velocity)


@pytest.mark.parametrize(
    ("age", "action", "rpm", "expected"),
    [
        (0.0, DriveAction.RUN, 1000, Setpoint(State.ENABLED, -1000)),
        (0.25, DriveAction.RUN, -1000, Setpoint(State.ENABLED, 1000)),
        (-0.1, DriveAction.RUN, 30000, Setpoint(State.ENABLED, -18000)),
        (0.0, DriveAction.RUN, -30000, Setpoint(State.ENABLED, 18000)),
        (0.26, DriveAction.RUN, 1000, Setpoint(State.ENABLED, 0)),
        (1.0, DriveAction.RUN, 1000, Setpoint(State.ENABLED, 0)),
        (1.01, DriveAction.RUN, 1000, STOP),
        (0.0, DriveAction.QUICK_STOP, 1000, STOP),
        (9.0, DriveAction.QUICK_STOP, 0, STOP),
        (0.0, DriveAction.DISABLE, 1000, OFF),
        (9.0, DriveAction.DISABLE, 0, OFF),
    ],
)
def test_commands_and_their_deadman(age: float, action: DriveAction, rpm: float, expected: Setpoint):
    assert setpoint_of(command(action, rpm), SECOND + round(age * SECOND), CONFIG) == expected


@pytest.mark.parametrize(
    ("age", "before", "after"),
    [
        (SECOND // 4, Setpoint(State.ENABLED, -1000), Setpoint(State.ENABLED, 0)),
        (SECOND, Setpoint(State.ENABLED, 0), STOP),
    ],
)
def test_a_command_counts_to_the_last_instant_of_its_time(age: int, before: Setpoint, after: Setpoint):
    run = command(DriveAction.RUN, 1000)
    assert setpoint_of(run, SECOND + age, CONFIG) == before
    assert setpoint_of(run, SECOND + age + 1, CONFIG) == after


def test_no_command_is_off_and_the_sign_is_configured():
    assert setpoint_of(None, 0, CONFIG) == OFF
    forward = EposConfig(inverted=False)
    assert setpoint_of(command(DriveAction.RUN, 500), SECOND, forward) == Setpoint(State.ENABLED, 500)


def test_a_motor_that_is_off_needs_no_quick_stop():
    assert settled(State.SWITCH_ON_DISABLED, State.QUICK_STOP)
    assert not settled(State.ENABLED, State.QUICK_STOP)
    assert not settled(State.SWITCH_ON_DISABLED, State.ENABLED)


def test_modes():
    modes = {
        State.ENABLED: DriveMode.ENABLED,
        State.QUICK_STOP: DriveMode.QUICK_STOP,
        State.SWITCH_ON_DISABLED: DriveMode.DISABLED,
        State.FAULT_REACTION_ENABLED: DriveMode.FAULT,
        State.FAULT: DriveMode.FAULT,
        State.REFRESH: DriveMode.STARTING,
        State.UNKNOWN: DriveMode.STARTING,
    }
    assert {state: drive_mode(state) for state in modes} == modes


@settings(max_examples=60)
@given(st.integers(-(2**31), 2**31 - 1), st.lists(st.integers(-40_000, 40_000), max_size=20))
def test_the_odometer_counts_through_the_wrap(start: int, steps: list[int]):
    odometer, true, now = Odometer(), start, 0
    odometer.update(start, now, FASTEST)
    for step in steps:
        true, now = true + step, now + SECOND // 20
        assert odometer.update((true + 2**31) % 2**32 - 2**31, now, FASTEST) == true - start


def test_the_odometer_takes_no_motion_from_a_counter_that_was_reset():
    odometer = Odometer()
    odometer.update(5_000_000, 0, FASTEST)
    assert odometer.update(5_000_100, SECOND, FASTEST) == 100
    assert odometer.update(0, SECOND + SECOND // 20, FASTEST) == 100
    assert odometer.update(50, SECOND + SECOND // 10, FASTEST) == 150
    odometer.restart()
    assert odometer.update(0, 60 * SECOND, FASTEST) == 150


IDENTITY = ControllerIdentity(0x2024, None, 10, 1, 500, 0, None, None, None, None)


def test_identity_is_compared_with_what_is_configured():
    IDENTITY.check(EposConfig(motor_type=10))
    IDENTITY.check(EposConfig(encoder_pulses_per_turn=None))
    with pytest.raises(DeviceMismatchError, match=r"0x2210/1 .* is 500, expected 512; 0x6402/0 .* is 10, expected 1"):
        IDENTITY.check(EposConfig(encoder_pulses_per_turn=512, motor_type=1))


def test_counts_per_turn_come_from_the_controller_or_the_configuration():
    assert IDENTITY.counts_per_turn(EposConfig(encoder_pulses_per_turn=None)) == 2000
    silent = ControllerIdentity(0x2024, None, None, None, None, None, None, None, None, None)
    assert silent.counts_per_turn(EposConfig(encoder_pulses_per_turn=512)) == 2048
    with pytest.raises(DeviceMismatchError, match="encoder_pulses_per_turn"):
        silent.counts_per_turn(EposConfig(encoder_pulses_per_turn=None))


@pytest.mark.parametrize(
    "bad",
    [{"kind": "epos2"}, {"node": 128}, {"max_motor_rpm": 0}, {"rate": 50.0}, {"command_timeout": 0.0}, {"baud": 38400}],
)
def test_bad_configurations_are_refused(bad: dict[str, object]):
    with pytest.raises(ValidationError):
        EposConfig.model_validate(bad)
