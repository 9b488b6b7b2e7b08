"""Route planner settings: light models, one ``kind`` each."""

from typing import Annotated, Literal

from pydantic import Field

from monstertruck_schemas.base import NotNegative, Positive, Schema

AtLeastOne = Annotated[float, Field(ge=1)]

Unknown = Literal["blocked", "dear", "free"]


class GoalConfig(Schema):
    """Settings shared by all route planners."""

    budget: Positive = 1.0
    """CPU time for a route and its improvement, with a clock (s)."""
    effort: Annotated[int, Field(gt=0)] = 60_000
    """Maximum number of expanded nodes and smoothing trials without a clock: equal inputs then give equal routes."""
    position_tolerance: NotNegative = 0.05
    """Maximum distance of a free pose that replaces an occupied goal (m)."""
    yaw_tolerance: NotNegative = 0.09
    """Heading tolerance at the goal (rad)."""
    margin: NotNegative = 0.0
    """Margin between footprint and obstacles (m)."""
    unknown: Unknown = "blocked"
    """Treatment of unknown cells: obstacles, free at an extra cost (``dear``), or free."""
    unknown_cost: NotNegative = 1.0
    """Extra cost per metre on unknown cells that are ``dear`` (m)."""


class DriveCosts(GoalConfig):
    """Costs of drivable motions; with the defaults, routes are nearly the shortest."""

    reverse_cost: AtLeastOne = 1.0
    """Cost per metre backward (m); above 1 for a truck whose sensors look ahead."""
    cusp_cost: NotNegative = 0.1
    """Cost of a change of direction (m)."""
    free_cusps: Annotated[int, Field(ge=0)] = 4
    """Number of changes of direction without an extra cost."""
    many_cusps_cost: NotNegative = 0.4
    """Extra cost of each further change of direction (m), because the truck stops there and its errors add up."""
    swing_cost: NotNegative = 0.01
    """Cost of a change of curvature (m); it favours few long arcs over many short ones."""
    crab_cost: AtLeastOne = 1.0
    """Cost per metre of translation (m)."""
    clearance: NotNegative = 0.1
    """Distance to obstacles below which motion costs more (m)."""
    clearance_cost: NotNegative = 0.1
    """Extra cost per metre in contact (m), falling to 0 at ``clearance``."""
    tilt_cost: NotNegative = 2.0
    """Extra cost per metre and radian of tilt (m)."""
    roughness_cost: NotNegative = 100.0
    """Extra cost per metre and metre of roughness (m)."""


class HybridConfig(DriveCosts):
    """Hybrid A*, with improvement of the route until the budget is used up."""

    kind: Literal["hybrid"] = "hybrid"
    heuristic_weight: AtLeastOne = 2.0
    """Heuristic weight; a greater weight finds a first route sooner."""
    narrow_margin: NotNegative = 0.03
    """Minimum margin, used if no path keeps the configured one (m)."""
    improve: bool = True
    """Smooth the route and try alternatives within the budget."""


class LatticeConfig(DriveCosts):
    """State lattice with motion primitives of exact radius; costs as in the author's planner."""

    kind: Literal["lattice"] = "lattice"
    cell: Positive = 0.05
    """Cell size (m)."""
    turn_factor: AtLeastOne = 2.0
    """Cost factor of a turn forward."""
    reverse_factor: AtLeastOne = 3.0
    """Cost factor of a metre backward."""
    reverse_turn_factor: AtLeastOne = 5.0
    """Cost factor of a turn or a translation backward."""
    heuristic_weight: AtLeastOne = 2.0
    """Heuristic weight of the first search; it falls to 1 within the budget."""


class GridAstarConfig(GoalConfig):
    """The author's first planner; its paths are not drivable motions."""

    kind: Literal["grid_astar"] = "grid_astar"
    neutral: Positive = 50.0
    """Cost of a free cell."""
    cost_factor: NotNegative = 3.0
    """Factor on a cell's costmap value, 0 to 252."""
    lethal: Positive = 200.0
    """Minimum costmap value of a closed cell."""
    inflation: NotNegative = 0.3
    """Extent of obstacle costs beyond the inscribed circle (m)."""
    decay: Positive = 10.0
    """Decay of the costs with distance (1/m)."""
