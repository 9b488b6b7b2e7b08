"""Wall following settings; defaults come from the coursework unless stated otherwise."""

import math
from typing import Annotated, Literal

from pydantic import Field

from monstertruck_planners.behave.api import BehaviourConfig

Metres = Annotated[float, Field(gt=0, le=5)]


class WallConfig(BehaviourConfig):
    """Settings shared by both published methods.

    Sonars are named ``l``, ``fl``, ``f``, ``fr`` and ``r``; a wall on the right uses the sonars of the right side.
    """

    side: Literal["left", "right"] = "left"
    """Side of the wall: left gives a clockwise lap"""
    distance: Metres = 0.30
    """Distance from the side sonar to the wall, m"""
    speed: Annotated[float, Field(gt=0, le=0.5)] = 0.2
    """Linear speed, m/s"""
    turn_rate: Annotated[float, Field(gt=0, le=1)] = 0.2
    """Yaw rate of turns, rad/s"""
    ramp: Annotated[float, Field(gt=0, le=5)] = 0.5
    """Duration of a cubic ramp, s"""
    hold: Annotated[float, Field(ge=0, le=0.5)] = 0.25
    """Maximum age of a sonar's last echo that replaces missing ones, s; 0: a missing echo reads as the maximum range"""
    approach_turn: Annotated[float, Field(ge=0, le=math.tau)] = 0.0
    """Angle of the initial arc towards the wall's side, rad; the coursework set a time by hand"""
    lap_length: Annotated[float, Field(gt=0, le=1000)] = 4.0
    """Minimum length of a lap, m"""
    lap_radius: Metres = 0.6
    """Distance from a previously passed place, by odometry, that completes a lap, m; grows with odometry drift"""
    laps: Annotated[int, Field(ge=1, le=100)] = 1
    """Number of laps to drive"""


class WallPdConfig(WallConfig):
    """Method 1: PD control of the distance, with D as the plain difference between two samples."""

    kind: Literal["wall_pd"] = "wall_pd"
    k_p: Annotated[float, Field(ge=0)] = 12.0
    """Yaw rate per distance error, rad/s/m"""
    k_d: Annotated[float, Field(ge=0)] = 11.3
    """Yaw rate per change of the error from one sample to the next, rad/s/m; not divided by the period"""
    trigger: Metres = 0.29
    """Front range that makes the robot turn away, m; after braking (0.06 m) and turning on the spot, the published
    value leaves the side sonar 0.05 m too near; 0.34 is about right"""
    offset: Annotated[float, Field(ge=0, le=1)] = 0.0
    """Distance of the diagonal sonar ahead of the side sonar when computing the wall angle, m: 0 as published, 0.05
    exact"""
    safety: Metres = 0.2
    """Range of the far diagonal sonar that also makes the robot turn away, m, in case the front sonar looks into a
    gap; our value, above the sonars' minimum range"""
    seen: Metres = 0.45
    """Side range below which the wall is detected, m; our value"""
    gap: Annotated[float, Field(ge=0, le=5)] = 0.0
    """Distance travelled without a side sonar after its range jumped up, because it looks into a gap, m; 0 as
    published: the robot turns into gaps"""
    aligned: Annotated[float, Field(ge=-1.5, le=0.5)] | None = None
    """Heading away from the wall, by side and diagonal sonar, that ends turning away, rad; null as published: the robot
    continues while it still faces the wall"""
    free: Metres = 0.8
    """Minimum front range of a free path, m; our value"""
    lead: Annotated[float, Field(ge=0, le=1)] = 0.0
    """Latency from an echo to the resulting motion, s: the controller predicts the distance this far ahead at constant
    heading; 0 as published: with 0.2 s in sonars, gate and drives the robot oscillates forever"""


class WallSwitchingConfig(WallConfig):
    """Method 2: two phases with ramps between them, no controller."""

    kind: Literal["wall_switching"] = "wall_switching"
    obstacle: Metres = 0.30
    """Range of the front, diagonal or side sonar below which the robot turns away, m"""
    beyond: Metres = 0.05
    """Excess over ``distance`` that makes the robot turn back towards the wall, m"""


class WallLineConfig(BehaviourConfig):
    """Method 3: a line fitted to the echoes in odom, with default values of our own."""

    kind: Literal["wall_line"] = "wall_line"
    rate: Annotated[float, Field(ge=10, le=50)] = 20.0
    """Steps per second"""
    side: Literal["left", "right"] = "left"
    """Side of the wall: left gives a clockwise lap"""
    distance: Metres = 0.30
    """Distance from the side sonar to the wall, m"""
    speed: Annotated[float, Field(gt=0, le=0.3)] = 0.29
    """Speed along the wall, m/s"""
    creep: Annotated[float, Field(gt=0, le=0.3)] = 0.12
    """Speed along a wall whose direction is still uncertain, m/s"""
    turn_rate: Annotated[float, Field(gt=0, le=1)] = 0.8
    """Maximum yaw rate of turns on the spot, rad/s"""
    acceleration: Annotated[float, Field(gt=0, le=0.6)] = 0.6
    """Maximum acceleration of a ramp, m/s^2 and rad/s^2"""
    jerk: Annotated[float, Field(gt=0, le=4.8)] = 4.8
    """Maximum jerk of a ramp, m/s^3 and rad/s^3"""
    braking: Annotated[float, Field(gt=0, le=0.6)] = 0.35
    """Maximum deceleration of a ramp to standstill before a wall, m/s^2: gentler than the gate's limit there"""
    lead: Annotated[float, Field(ge=0, le=0.3)] = 0.08
    """Latency from a request to the body's motion, s: requests are taken from the ramp this far ahead"""
    play: Annotated[float, Field(ge=0, le=0.3)] = 0.0
    """Lag of the body behind its wheels, s, a part of ``lead``: encoder odometry is ahead of the body by this time"""
    beam: bool = False
    """Whether sonars hear along their axis only; otherwise in the cone given by ``sensor/sonar``"""
    critical_angle: Annotated[float, Field(gt=0, le=1.4)] = 0.45
    """Maximum angle between a wall's normal and a returning sound, rad; without ``beam``"""
    window: Metres = 3.0
    """Travelled distance whose echoes are used for the line, m: longer is steadier but relies longer on odometry"""
    stiffness: Annotated[float, Field(gt=0, le=2)] = 0.3
    """Distance constant of the controller's response to a distance error, m; critically damped"""
    door: Metres = 1.3
    """Distance to continue straight along the line without a wall before searching for another wall, m"""
    search: Annotated[float, Field(gt=0, le=100)] = 25.0
    """Maximum distance without a wall, m; the robot then gives up"""
    lap_length: Annotated[float, Field(gt=0, le=1000)] = 4.0
    """Minimum length of a lap, m"""
    lap_radius: Metres = 0.6
    """Distance from a previously passed place, by odometry, that completes a lap, m; plus 1 % of the lap length"""
    laps: Annotated[int, Field(ge=1, le=100)] = 1
    """Number of laps to drive"""
