"""Messages of the ``cmd`` group: commands to the actuators, sent only by the gate."""

from enum import StrEnum

from monstertruck_schemas.base import Message, servos_of


class DriveAction(StrEnum):
    """Mode of a drive command."""

    DISABLE = "disable"
    """Power stage off: the motor coasts."""
    RUN = "run"
    """Follow ``motor_velocity`` (0 holds)."""
    QUICK_STOP = "quick_stop"
    """Brake with the configured maximum deceleration at once, ahead of queued commands."""


class DriveCommand(Message):
    """Drive motor command."""

    action: DriveAction
    """Action of the drive."""
    speed: float
    """Wheel speed over ground, m/s."""
    motor_velocity: float
    """Motor shaft speed, rad/s, robot's sign (forward positive)."""


class SteeringCommand(Message):
    """Steering of both axles: bicycle angles and the corresponding servo angles."""

    front: float
    """Axle angle of the equivalent bicycle, rad, left positive; 0 for a motion without an equivalent bicycle."""
    rear: float
    """Angle of the rear axle, likewise."""
    front_servo: float
    """Servo angle, rad, left positive, 0 = straight ahead."""
    rear_servo: float
    """Servo angle of the rear axle, likewise."""
    front_right_servo: float | None = None
    """Servo angle of the front right wheel, if every wheel has a servo; ``front_servo`` is then the front left one."""
    rear_right_servo: float | None = None
    """Servo angle of the rear right wheel; ``rear_servo`` is then the rear left one."""
    deadman: bool = True
    """Level of the deadman line, if wired: False stops the motor without its controller's software."""

    @property
    def servos(self) -> tuple[float, ...]:
        """All servo angles: front and rear, or front left, front right, rear left and rear right."""
        return servos_of(self.front_servo, self.front_right_servo, self.rear_servo, self.rear_right_servo)
