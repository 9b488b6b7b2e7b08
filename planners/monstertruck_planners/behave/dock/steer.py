"""Control laws of docking (pure): steering onto the axis of a dock, and speed towards a stop."""

import math
from typing import Final

LENGTH: Final = 0.1
"""Distance in which an error across the axis falls to 1/e, twice over (m): critically damped."""


def curvature(across: float, turn: float, way: float, limit: float) -> float:
    """Return the curvature (1/m) per distance travelled that leads a robot onto an axis.

    Args:
        across: distance to the left of the axis (m).
        turn: heading relative to the axis (rad).
        way: +1 for a robot that drives ahead along the axis, -1 for one that reverses along it.
        limit: maximum curvature (1/m).
    """
    # 0.2: maximum angle to the axis, rad: the camera keeps the tag in view
    towards = min(max(-way * across / (2.0 * LENGTH), -0.2), 0.2)
    return min(max(2.0 * (towards - turn) / LENGTH, -limit), limit)


def pace(left: float, speed: float) -> float:
    """Return the speed (m/s) with ``left`` metres to a stop; it falls in proportion to the distance.

    0.6 1/s: a robot that responds within 0.3 s does not overshoot. 0.012 m/s: slower set-points do not turn a motor.
    """
    return min(speed, max(0.6 * left, 0.012))


def predicted(across: float, turn: float, left: float) -> float:
    """Return the distance across the axis (m) that is left after ``left`` metres along it, for a small heading."""
    return (across + (turn + across / LENGTH) * left) * math.exp(-left / LENGTH)
