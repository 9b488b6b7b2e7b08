"""What the daemon needs to know of a controller of driven shafts, whatever its kind."""

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
