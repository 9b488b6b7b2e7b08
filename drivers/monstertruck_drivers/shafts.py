"""What the daemon needs to know of a controller of driven shafts or of steering, whatever its kind."""

from typing import Any, NamedTuple


class MotorLimits(NamedTuple):
    """What a motor does at most, at its own shaft; ``motor_limits`` of a drive's settings."""

    rate: float
    """Greatest rate, rad/s."""
    deceleration: float
    """Deceleration of its ordinary ramp, rad/s^2."""
    quick_deceleration: float
    """Deceleration of its quick stop, rad/s^2."""


def motor_limits(settings: Any) -> MotorLimits | None:
    """Of a drive's settings; None = a kind that does not say."""
    limits: MotorLimits | None = getattr(settings, "motor_limits", None)
    return limits


class SteeringOutputs(NamedTuple):
    """What the servos of a steering controller do; ``steering_outputs`` of its settings."""

    reaches: tuple[tuple[float, float], ...]
    """For every servo of a ``SteeringCommand``, in its order: servo angles, rad, to the right (negative) and to the
    left. Both are 0 where the controller has no output for it."""
    dead_time: float | None
    """From a command to the first movement of the wheels, s; None = not measured."""
    lag: float | None
    """Time constant with which the wheels then turn, s; None = not measured."""

    @property
    def axles(self) -> tuple[tuple[float, float], tuple[float, float]]:
        """Reach of the front and of the rear axle; where every wheel has a servo, of the left ones."""
        return self.reaches[0], self.reaches[len(self.reaches) // 2]


def steering_outputs(settings: Any) -> SteeringOutputs | None:
    """Return what the servos of a device do; None if it steers nothing."""
    outputs: SteeringOutputs | None = getattr(settings, "steering_outputs", None)
    return outputs


def stop_words(settings: Any) -> str | None:
    """Return what the stop script needs to know besides kind, port and baud rate; None if it cannot stop the kind."""
    words: str | None = getattr(settings, "stop_words", None)
    return words
