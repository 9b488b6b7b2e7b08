"""Settings of the mapper: noise models and limits, the same for every sensor and place."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class MapperConfig:
    """Defaults serve a slow truck as well as a fast robot with sparse scans; nothing here is fitted to one log."""

    key_distance: float = 0.3
    """Way after which a scan joins the map, m."""
    key_turn: float = 0.35
    """Turn after which a scan joins the map, rad."""
    key_points: int = 360
    """Points kept of a key scan at most."""
    key_cell: float = 0.04
    """About one point of a key scan is kept per square of this edge, m."""
    longest: float = 30.0
    """Longer ranges are not used, m."""
    odometry_floor: tuple[float, float] = (0.02, 0.05)
    """Standard deviation of any odometry step, m and rad."""
    odometry_distance: float = 0.1
    """Standard deviation of a way per metre, and of its sideways part."""
    odometry_turn: tuple[float, float] = (0.2, 0.1)
    """Standard deviation of a turn per radian turned and per metre driven, rad."""
    blind_speed: tuple[float, float] = (0.5, 0.6)
    """Standard deviation of the motion predicted without odometry, m/s and rad/s."""
    drift_distance: tuple[float, float] = (0.01, 0.01)
    """Standard deviation of the position of a matched key scan against its neighbour, m and per metre between them."""
    drift_turn: tuple[float, float] = (0.003, 0.005)
    """The same of its yaw, rad and per radian between them."""
    local_spread: float = 0.15
    """Key scans surer than this to each other, m, are mapped as one submap."""
    local_reach: float = 5.0
    """Key scans up to this far from the robot make its submap, m."""
    local_keys: int = 20
    """Key scans of a submap at most."""
    neighbours: int = 4
    """Relations from a new key scan to those it overlaps."""
    fastest: tuple[float, float] = (5.0, 1.0)
    """Odometry that claims a greater way is not believed, m/s and m besides (stamps come in bursts)."""
    most_keys: int = 4000
    """Key scans at most; then the most dispensable go."""
    thinning: float = 0.1
    """Share of them that goes at once."""
    most_scans: int = 200_000
    """Scans of the trajectory at most; then every second one is forgotten."""
