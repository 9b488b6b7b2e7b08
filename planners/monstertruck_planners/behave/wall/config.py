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
    """Distance from the side sonar to the wall, m"""
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
    """Least length of a lap, m"""
    lap_radius: Metres = 0.6
    """So near to a place that it passed, by odometry, a lap is complete, m; grows with the odometry's drift"""
    laps: Annotated[int, Field(ge=1, le=100)] = 1
    """Laps after which it stops"""


class WallPdConfig(WallConfig):
    """Method 1: PD control of the distance, D as the plain difference between two samples."""

    kind: Literal["wall_pd"] = "wall_pd"
    k_p: Annotated[float, Field(ge=0)] = 12.0
    """Yaw rate per distance error, rad/s/m"""
    k_d: Annotated[float, Field(ge=0)] = 11.3
    """Yaw rate per change of the error from one sample to the next, rad/s/m; not divided by the period"""
    trigger: Metres = 0.29
    """Front range at which it turns away, m; after braking from there (0.06 m) and turning on the spot the published
    one leaves the side sonar 0.05 m too near, 0.34 about right"""
    offset: Annotated[float, Field(ge=0, le=1)] = 0.0
    """Distance of the diagonal sonar ahead of the side one in the angle to the wall, m: 0 as published, 0.05 exact"""
    safety: Metres = 0.2
    """Range of the far diagonal sonar at which it turns away as well, m: for looking into a gap; our figure, above the
    least range of the sonars"""
    seen: Metres = 0.45
    """Side ranges below which the wall is seen, m; our figure"""
    gap: Annotated[float, Field(ge=0, le=5)] = 0.0
    """Distance over which a side sonar whose range jumped up looks into a gap and does not count, m; 0 as published:
    the robot turns into gaps"""
    aligned: Annotated[float, Field(ge=-1.5, le=0.5)] | None = None
    """Heading away from the wall by side and diagonal sonar from which on turning away ends, rad; as published none:
    the robot drives on while it still faces the wall"""
    free: Metres = 0.8
    """Front range from which the path is free again, m; our figure"""
    lead: Annotated[float, Field(ge=0, le=1)] = 0.0
    """Seconds from an echo to the motion that answers it: the distance is that after so long on the present heading; 0
    as published: a robot whose sonars, gate and drives take 0.2 s swings without end"""


class WallSwitchingConfig(WallConfig):
    """Method 2: two phases with ramps between them, no controller."""

    kind: Literal["wall_switching"] = "wall_switching"
    obstacle: Metres = 0.30
    """Range of any of front, diagonal and side sonar below which it turns away, m"""
    beyond: Metres = 0.05
    """Metres beyond ``distance`` from which on it turns back towards the wall"""


class WallLineConfig(BehaviourConfig):
    """Method 3, our own: a line fitted to the echoes, in odom; figures are ours."""

    kind: Literal["wall_line"] = "wall_line"
    rate: Annotated[float, Field(ge=10, le=50)] = 20.0
    """Steps a second"""
    side: Literal["left", "right"] = "left"
    """Where the wall is: left is a clockwise lap"""
    distance: Metres = 0.30
    """Distance from the side sonar to the wall, m"""
    speed: Annotated[float, Field(gt=0, le=0.3)] = 0.29
    """Along the wall, m/s"""
    creep: Annotated[float, Field(gt=0, le=0.3)] = 0.12
    """Along a wall whose direction is not known well yet, m/s"""
    turn_rate: Annotated[float, Field(gt=0, le=1)] = 0.8
    """Greatest yaw rate of turns on the spot, rad/s"""
    acceleration: Annotated[float, Field(gt=0, le=0.6)] = 0.6
    """Greatest of a ramp, m/s^2 and rad/s^2"""
    jerk: Annotated[float, Field(gt=0, le=4.8)] = 4.8
    """Greatest of a ramp, m/s^3 and rad/s^3"""
    braking: Annotated[float, Field(gt=0, le=0.6)] = 0.35
    """Greatest deceleration of a ramp to standstill before a wall, m/s^2: gentler than what the gate allows there"""
    lead: Annotated[float, Field(ge=0, le=0.3)] = 0.08
    """Seconds from a request to the body's motion: requests are those of a ramp so much later"""
    play: Annotated[float, Field(ge=0, le=0.3)] = 0.0
    """The part of it by which the body follows its wheels, s: odometry by encoders is ahead of the body by so much"""
    beam: bool = False
    """Sonars hear along their axis only; otherwise in the cone that ``sensor/sonar`` states"""
    critical_angle: Annotated[float, Field(gt=0, le=1.4)] = 0.45
    """Greatest angle from a wall's normal at which sound comes back, rad; without ``beam``"""
    window: Metres = 3.0
    """Distance over which echoes count for the line, m: longer is steadier, and trusts the odometry longer"""
    stiffness: Annotated[float, Field(gt=0, le=2)] = 0.3
    """Distance in which a distance error decays by the control, m; critically damped"""
    door: Metres = 1.3
    """Distance without a wall that is driven straight on along the line before another wall is searched for, m"""
    search: Annotated[float, Field(gt=0, le=100)] = 25.0
    """Distance without a wall after which it gives up, m"""
    lap_length: Annotated[float, Field(gt=0, le=1000)] = 4.0
    """Least length of a lap, m"""
    lap_radius: Metres = 0.6
    """So near to a place that it passed, by odometry, a lap is complete, m, and 1 % of the lap's length more"""
    laps: Annotated[int, Field(ge=1, le=100)] = 1
    """Laps after which it stops"""
