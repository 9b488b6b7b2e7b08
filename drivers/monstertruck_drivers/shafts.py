"""Properties that the daemon needs from any kind of drive or steering controller."""

from typing import Any, NamedTuple


class MotorLimits(NamedTuple):
    """Limits of a motor at its shaft; the value of ``motor_limits`` in a drive's settings."""

    rate: float
    """Maximum rate (rad/s)."""
    deceleration: float
    """Deceleration of its ordinary ramp (rad/s^2)."""
    quick_deceleration: float
    """Deceleration of its quick stop (rad/s^2)."""


def motor_limits(settings: Any) -> MotorLimits | None:
    """Return the motor limits from a drive's settings; None if the kind does not declare them."""
    limits: MotorLimits | None = getattr(settings, "motor_limits", None)
    return limits


class SteeringOutputs(NamedTuple):
    """Steering outputs of a controller; the value of ``steering_outputs`` in its settings."""

    reaches: tuple[tuple[float, float], ...]
    """Maximum angles of every servo, in the order of ``SteeringCommand`` (rad): to the right (negative) and to the
    left. Both are 0 if the controller has no output for it.
    """
    dead_time: float | None
    """Dead time from a command to the first movement of the wheels (s); None: not measured."""
    lag: float | None
    """Time constant of the wheels' movement after the dead time (s); None: not measured."""

    @property
    def axles(self) -> tuple[tuple[float, float], tuple[float, float]]:
        """Reach of the front and rear axles, or of their left servos if every wheel has a servo."""
        return self.reaches[0], self.reaches[len(self.reaches) // 2]


def steering_outputs(settings: Any) -> SteeringOutputs | None:
    """Return a device's steering outputs; None if it does not steer."""
    outputs: SteeringOutputs | None = getattr(settings, "steering_outputs", None)
    return outputs


def stop_words(settings: Any) -> str | None:
    """Return the stop script's arguments besides kind, port and baud rate; None if the script cannot stop this kind."""
    words: str | None = getattr(settings, "stop_words", None)
    return words
