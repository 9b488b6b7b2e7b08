"""Settings of mapping and localisation; light, for the daemon's start."""

from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field

from monstertruck_schemas.base import Positive, Schema

Count = Annotated[int, Field(gt=0)]


class MapperConfig(Schema):
    """Noise models and limits, the same for every sensor and place; every number is positive.

    The defaults suit a slow truck as well as a fast robot with sparse scans; none is fitted to one log.
    """

    key_distance: Positive = 0.3
    """Distance between scans integrated into the grid (m)."""
    key_turn: Positive = 0.35
    """Turn between scans integrated into the grid (rad)."""
    key_points: Count = 360
    """Maximum number of points of a keyframe."""
    key_cell: Positive = 0.04
    """Edge of squares with about one point of a keyframe each (m)."""
    longest: Positive = 30.0
    """Maximum range that is used (m)."""
    odometry_floor: tuple[Positive, Positive] = (0.02, 0.05)
    """Minimum standard deviation of an odometry step (m, rad) of a robot that moves: late stamps, slip."""
    odometry_distance: Positive = 0.1
    """Standard deviation of a displacement per metre, forward and sideways."""
    odometry_turn: tuple[Positive, Positive] = (0.2, 0.1)
    """Standard deviation of a turn per radian turned and per metre travelled (rad)."""
    blind_speed: tuple[Positive, Positive] = (0.5, 0.6)
    """Standard deviation of the motion predicted without odometry (m/s, rad/s)."""
    drift_distance: tuple[Positive, Positive] = (0.01, 0.01)
    """Standard deviation of a matched keyframe's position against its neighbour (m, and per metre between them)."""
    drift_turn: tuple[Positive, Positive] = (0.003, 0.005)
    """Standard deviation of its yaw (rad, and per radian between them)."""
    local_spread: Positive = 0.15
    """Maximum drift between keyframes of one submap (m)."""
    local_reach: Positive = 5.0
    """Maximum distance of a submap's keyframes from the robot (m)."""
    local_keys: Count = 20
    """Maximum number of keyframes of a submap."""
    neighbours: Count = 4
    """Maximum number of edges from a new keyframe to those it overlaps."""
    fastest: tuple[Positive, Positive] = (5.0, 1.0)
    """Maximum speed of odometry that is used (m/s), with an allowance (m), because stamps come in bursts."""
    most_keys: Count = 4000
    """Maximum number of keyframes; beyond it, the most redundant are pruned."""
    pruning: Positive = 0.1
    """Share of the keyframes removed by one pruning."""
    most_scans: Count = 200_000
    """Maximum number of scans of the trajectory; beyond it, every second one is dropped."""


class GridConfig(Schema):
    """Occupancy grid: cells and sensor model."""

    resolution: Annotated[float, Field(ge=0.01, le=1)] = 0.05
    """Edge of a cell (m)."""
    hit: Annotated[float, Field(gt=0.5, lt=1)] = 0.7
    """Probability that the cell at the end of a beam is occupied."""
    miss: Annotated[float, Field(gt=0, lt=0.5)] = 0.4
    """Probability that a cell passed by a beam is occupied."""
    limit: Annotated[float, Field(gt=0.5, lt=1)] = 0.98
    """Maximum certainty of a cell; it lets objects that move away disappear."""
    passed: Positive | None = None
    """Range freed by beams without an echo (m); null ignores them: dark and polished surfaces return no echo either"""
    free_footprint: bool = False
    """Mark the ground under the robot as free, although its sensor does not see it"""
    spacing: Positive = 0.1
    """Distance between scans integrated into the grid (m)."""
    turn: Positive = 0.1
    """Turn between scans integrated into the grid (rad)."""
    pause: Positive = 1.0
    """Time between scans integrated into the grid (s)."""
    remembered: Annotated[int, Field(ge=16)] = 6000
    """Number of scans stored to rebuild the grid after a loop closure; beyond it, every other old one is dropped."""


class SlamConfig(Schema):
    """Simultaneous localisation and mapping, localisation in a saved map, or localisation by an off-board program."""

    mode: Literal["mapping", "localisation", "ros2"] = "mapping"
    """`ros2`: a client such as `monstertruckd ros2` localises with amcl or slam_toolbox; the daemon matches no scans"""
    map: Path | None = None
    """Folder of the saved map; needed for localisation"""
    save: Path | None = None
    """Folder for saving the map at the end and every ``save_period`` seconds; null saves nothing"""
    save_period: Positive = 60.0
    """Interval between saves of the map (s)."""
    front: Literal["planar", "kiss"] = "planar"
    """Scan matcher"""
    mapper: MapperConfig = MapperConfig()
    grid: GridConfig = GridConfig()
    max_tilt: Annotated[float, Field(gt=0, le=1.5)] = 0.1
    """Maximum tilt of the scan plane (rad); scans beyond it are not used"""
    ceiling: Positive | None = None
    """Height of the ceiling above the base (m); null without a ceiling"""
    tiles_period: Positive = 1.0
    """Time between two messages of changed tiles (s)"""
    map_period: Positive = 10.0
    """Maximum delay before a changed map is published as a whole (s)"""
    slew: tuple[Positive, Positive] = (0.3, 0.5)
    """Maximum rate at which the pose in map follows corrections below ``jump`` (m/s, rad/s)"""
    jump: Positive = 1.0
    """Minimum size of corrections that are applied immediately (m)"""
    deviation: tuple[Positive, Positive] = (0.1, 0.05)
    """Standard deviation of a pose localised off board (m, rad)"""
    latency: Annotated[float, Field(gt=0, le=1)] = 0.03
    """Latency of a worker step on the virtual clock (s)"""
    deadline: Annotated[float, Field(gt=0, le=60)] = 20.0
    """Maximum silence of the worker before it is killed (s)"""
