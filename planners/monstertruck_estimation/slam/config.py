"""Settings of mapping and localisation; light, for the daemon's start."""

from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field

from monstertruck_schemas.base import Positive, Schema

Count = Annotated[int, Field(gt=0)]


class MapperConfig(Schema):
    """Noise models and limits, the same for every sensor and place; every number is positive.

    The defaults serve a slow truck as well as a fast robot with sparse scans; none is fitted to one log.
    """

    key_distance: Positive = 0.3
    """Distance after which a scan is integrated into the grid, m."""
    key_turn: Positive = 0.35
    """Turn after which a scan is integrated into the grid, rad."""
    key_points: Count = 360
    """Most points of a keyframe."""
    key_cell: Positive = 0.04
    """About one point of a keyframe is kept per square of this edge, m."""
    longest: Positive = 30.0
    """Longer ranges are not used, m."""
    odometry_floor: tuple[Positive, Positive] = (0.02, 0.05)
    """Least standard deviation of an odometry step, m and rad."""
    odometry_distance: Positive = 0.1
    """Standard deviation of a displacement per metre, forward and sideways."""
    odometry_turn: tuple[Positive, Positive] = (0.2, 0.1)
    """Standard deviation of a turn per radian turned and per metre driven, rad."""
    blind_speed: tuple[Positive, Positive] = (0.5, 0.6)
    """Standard deviation of the motion predicted without odometry, m/s and rad/s."""
    drift_distance: tuple[Positive, Positive] = (0.01, 0.01)
    """Standard deviation of the position of a matched keyframe against its neighbour, m and per metre between them."""
    drift_turn: tuple[Positive, Positive] = (0.003, 0.005)
    """Standard deviation of its yaw, rad and per radian between them."""
    local_spread: Positive = 0.15
    """Keyframes whose drift against each other is less than this, m, belong to one submap."""
    local_reach: Positive = 5.0
    """Keyframes up to this far from the robot belong to its submap, m."""
    local_keys: Count = 20
    """Most keyframes of a submap."""
    neighbours: Count = 4
    """Most edges from a new keyframe to those it overlaps."""
    fastest: tuple[Positive, Positive] = (5.0, 1.0)
    """Odometry that moves faster is ignored, m/s, with an allowance in m (stamps come in bursts)."""
    most_keys: Count = 4000
    """Most keyframes; beyond, the most redundant are pruned."""
    pruning: Positive = 0.1
    """Share of the keyframes that one pruning removes."""
    most_scans: Count = 200_000
    """Most scans of the trajectory; beyond, every second one is dropped."""


class GridConfig(Schema):
    """Occupancy grid: cells and sensor model."""

    resolution: Annotated[float, Field(ge=0.01, le=1)] = 0.05
    """Edge of a cell, m."""
    hit: Annotated[float, Field(gt=0.5, lt=1)] = 0.7
    """Probability that a cell in which a beam ends is occupied."""
    miss: Annotated[float, Field(gt=0, lt=0.5)] = 0.4
    """Probability that a cell a beam has passed is occupied."""
    limit: Annotated[float, Field(gt=0.5, lt=1)] = 0.98
    """No cell becomes more certain than this, so that objects that move away disappear."""
    passed: Positive | None = None
    """Beams that meet nothing within the sensor's range free the cells up to this distance, m; null = they say
    nothing: a dark or a polished surface answers no beam either"""
    free_footprint: bool = False
    """The ground under the robot is free, although its sensor does not see it"""
    spacing: Positive = 0.1
    """Distance after which a scan is integrated into the grid, m."""
    turn: Positive = 0.1
    """Turn after which a scan is integrated into the grid, rad."""
    pause: Positive = 1.0
    """Time after which a scan is integrated into the grid, s."""
    remembered: Annotated[int, Field(ge=16)] = 6000
    """Scans stored to rebuild the grid after a loop closure; beyond, every other old one is dropped."""


class SlamConfig(Schema):
    """Simultaneous localisation and mapping, or localisation in a saved map, or by a program off board."""

    mode: Literal["mapping", "localisation", "ros2"] = "mapping"
    """`ros2`: a client localises, such as `monstertruckd ros2` with amcl or slam_toolbox; no scan is matched here"""
    map: Path | None = None
    """Folder of the saved map; needed for localisation"""
    save: Path | None = None
    """Folder the map is saved to at the end and every ``save_period`` seconds; null = nowhere"""
    save_period: Positive = 60.0
    front: Literal["planar", "kiss"] = "planar"
    """Scan matcher"""
    witness: Literal["kiss"] | None = None
    """Scan odometry that the estimate is compared with; a difference of more than 0.2 m over 5 s is an event"""
    mapper: MapperConfig = MapperConfig()
    grid: GridConfig = GridConfig()
    max_tilt: Annotated[float, Field(gt=0, le=1.5)] = 0.1
    """Scans whose plane was tilted more than this are left out, rad"""
    ceiling: Positive | None = None
    """Height of the ceiling over the base, m, where there is one"""
    tiles_period: Positive = 1.0
    """Seconds between two messages of changed tiles"""
    map_period: Positive = 10.0
    """Seconds after which a changed map is published whole, at the latest"""
    slew: tuple[Positive, Positive] = (0.3, 0.5)
    """Rate at which the pose in map follows corrections at most, m/s and rad/s, so that it does not jump."""
    jump: Positive = 1.0
    """Corrections greater than this are applied immediately, m"""
    deviation: tuple[Positive, Positive] = (0.1, 0.05)
    """Standard deviation of a pose that was localised off board, m and rad"""
    latency: Annotated[float, Field(gt=0, le=1)] = 0.03
    """Seconds after which a step of the worker counts on the virtual clock"""
    deadline: Annotated[float, Field(gt=0, le=60)] = 20.0
    """Seconds after which a silent worker is killed"""
