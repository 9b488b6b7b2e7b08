"""Settings of wall following; figures are those of the coursework unless said."""

import math
from typing import Annotated, Literal

from pydantic import Field

from monstertruck_planners.behave.api import BehaviourConfig

Metres = Annotated[float, Field(gt=0, le=5)]


class WallConfig(BehaviourConfig):
    """What both published methods share.

    Sonars are named ``l``, ``fl``, ``f``, ``fr`` and ``r``; with the wall on the right the other side's serve.
    """

    side: Literal["left", "right"] = "left"
    """Where the wall is: left is a clockwise lap"""
    distance: Metres = 0.30
    """From the side sonar to the wall, m"""
    speed: Annotated[float, Field(gt=0, le=0.5)] = 0.2
    """Linear speed, m/s"""
    turn_rate: Annotated[float, Field(gt=0, le=1)] = 0.2
    """Yaw rate of turns, rad/s"""
    ramp: Annotated[float, Field(gt=0, le=5)] = 0.5
    """Duration of a cubic ramp, s"""
    hold: Annotated[float, Field(ge=0, le=0.5)] = 0.25
    """Seconds over which a sonar's last echo stands for missing ones; 0 = a missing echo is the greatest range"""
    approach_turn: Annotated[float, Field(ge=0, le=math.tau)] = 0.0
    """Angle of the arc at the beginning, towards the wall's side, rad; the coursework set a time by hand"""
    lap_length: Annotated[float, Field(gt=0, le=1000)] = 4.0
    """Least way of a lap, m"""
    lap_radius: Metres = 0.6
    """So near to where following began, by odometry, a lap is complete, m; grows with the odometry's drift"""
    laps: Annotated[int, Field(ge=1, le=100)] = 1
    """After which it stops"""


class WallPdConfig(WallConfig):
    """Method 1: PD control of the distance, D as the plain difference between two samples."""

    kind: Literal["wall_pd"] = "wall_pd"
    k_p: Annotated[float, Field(ge=0)] = 12.0
    """Yaw rate per distance error, rad/s/m"""
    k_d: Annotated[float, Field(ge=0)] = 11.3
    """Yaw rate per change of the error from one sample to the next, rad/s/m; not divided by the period"""
    trigger: Metres = 0.29
    """Front range at which it turns away, m"""
    offset: Annotated[float, Field(ge=0, le=1)] = 0.0
    """Distance of the diagonal sonar ahead of the side one in the angle to the wall, m: 0 as published, 0.05 exact"""
    safety: Metres = 0.12
    """Range of the far diagonal sonar at which it turns away as well, m: for looking into a gap; our figure"""
    seen: Metres = 0.45
    """Side ranges below which the new wall is seen, m; our figure"""
    free: Metres = 0.8
    """Front range from which the way is free again, m; our figure"""


class WallSwitchingConfig(WallConfig):
    """Method 2: two phases with ramps between them, no controller."""

    kind: Literal["wall_switching"] = "wall_switching"
    obstacle: Metres = 0.30
    """Range of any of front, diagonal and side sonar below which it turns away, m"""
    beyond: Metres = 0.05
    """Metres beyond ``distance`` from which on it turns back towards the wall"""
