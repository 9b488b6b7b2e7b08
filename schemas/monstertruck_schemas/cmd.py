"""Messages of the ``cmd`` group: what the gate, and only the gate, sent to the actuators."""

from enum import StrEnum

from monstertruck_schemas.base import Message


class DriveAction(StrEnum):
    """What the drive controller has to do."""

    DISABLE = "disable"
    """Power stage off: the motor coasts."""
    RUN = "run"
    """Follow ``motor_velocity`` (0 holds)."""
    QUICK_STOP = "quick_stop"
    """Brake as hard as configured, now, ahead of everything queued."""


class DriveCommand(Message):
    """Drive motor command."""

    action: DriveAction
    speed: float
    """Wheel speed over ground, m/s."""
    motor_velocity: float
    """The same at the motor shaft, rad/s, robot's sign (forward positive)."""


class SteeringCommand(Message):
    """Steering of both axles: bicycle angles and the servo angles they need."""

    front: float
    """Axle angle, rad, left positive."""
    rear: float
    front_servo: float
    """Servo angle, rad, left positive, 0 = straight ahead."""
    rear_servo: float
    deadman: bool = True
    """Level of the deadman line, where it is wired: False stops the motor without a word to its controller."""
