"""Printed results of the skid-steer paper, seven circles and a line, with its contradictions."""

from dataclasses import dataclass
from typing import Final

from monstertruck_kinematics.identification import PUBLISHED_CIRCLES, MeasuredCircle


@dataclass(frozen=True)
class PublishedCircle:
    """One row of the paper's table."""

    measured: MeasuredCircle
    speed_deviation: float
    """Deviation from the ideal speed as printed, %."""
    recomputed_deviation: float | None
    """Deviation from its own two speeds; None if printed without a sign."""
    radius_deviation: float
    """As printed, %."""
    drift: tuple[float, float] | None
    """Drift of the centre, m/s; None: only its size is printed."""
    drift_speed: float
    """As printed, m/s."""
    intercepts: tuple[float, float] | None
    """X and Y of the centre's fit at time 0, m."""
    slip: str = ""
    """Contradiction in the paper."""


_ROWS: Final = (
    (12.34, 10.4, 33.33, (-0.000901, -0.000128), 0.00091, (1.99, 0.59), "speed deviation: 10.4 % by its own speeds"),
    (13.19, 13.3, 33.33, (-0.000071, -0.000273), 0.000282, (2.05, 0.43), ""),
    (9.39, 10.5, 33.33, (-0.000025, -0.000163), 0.000164, (2.14, 0.54), "speed deviation: 10.5 % by its own speeds"),
    (11.87, 11.5, 47.6, (-0.000869, -0.000301), 0.000921, (1.65, 2.37), ""),
    (
        6.85,
        6.9,
        47.6,
        (-0.000132, -0.0000967),
        0.000179,
        (1.81, 2.42),
        "drift: 0.0164 cm/s by its own components",
    ),
    (13.69, 14.0, 47.6, (-0.0000415, -0.0000759), 0.000086, (1.70, 2.52), ""),
    (14.63, None, 4.76, None, 0.0005, None, "deviations without a sign: 1.40 or 1.88 cm/s, 5.0 or 5.5 cm"),
)

CIRCLES: Final = tuple(PublishedCircle(circle, *row) for circle, row in zip(PUBLISHED_CIRCLES, _ROWS, strict=True))

SLIPS: Final = (
    "The paper's conclusion prints the drifts of the centres ten times too large (0.91 cm/s for 0.091).",
    "Figure 7 is captioned 2:1 and shows 3:1.",
    "The line's theoretical speed is printed as 3.24 cm/s; 2.1 cm x 1.57 rad/s are 3.30.",
    "All measured speeds exceed the ideal ones, although slip can only reduce them: the effective wheel "
    "radius is larger.",
)


def nearest(left: float, right: float) -> PublishedCircle | None:
    """The published circle of such wheel rates, rad/s, whichever side is the faster; None if there is none."""
    slow, fast = sorted((abs(left), abs(right)))
    for row in CIRCLES:
        if abs(row.measured.right - fast) < 0.02 and abs(row.measured.left - slow) < 0.02:
            return row
    return None
