"""Settings of the route planners: light models, one ``kind`` each."""

from typing import Annotated, Literal

from pydantic import Field

from monstertruck_schemas.base import NotNegative, Positive, Schema

AtLeastOne = Annotated[float, Field(ge=1)]

Unknown = Literal["blocked", "dear", "free"]


class GoalConfig(Schema):
    """Shared by all route planners."""

    budget: Positive = 1.0
    """Processor time for a route and its improvement, s, if there is a clock."""
    effort: Annotated[int, Field(gt=0)] = 60_000
    """Nodes expanded and smoothing trials, if there is no clock: equal inputs then give equal routes."""
    position_tolerance: NotNegative = 0.05
    """If the goal itself is not free, a free pose this near is accepted, m."""
    yaw_tolerance: NotNegative = 0.09
    """Tolerance of the heading at the goal, rad."""
    margin: NotNegative = 0.0
    """Kept between footprint and obstacles, m."""
    unknown: Unknown = "blocked"
    """Unknown cells are obstacles, free at an extra cost (``dear``), or free."""
    unknown_cost: NotNegative = 1.0
    """Extra cost of a metre on unknown cells that are ``dear``, m."""


class DriveCosts(GoalConfig):
    """Costs of drivable motions. With the defaults routes are nearly the shortest ones."""

    reverse_cost: AtLeastOne = 1.0
    """Cost of a metre backward, m; above 1 for a truck whose sensors look ahead."""
    cusp_cost: NotNegative = 0.1
    """Cost of a change of direction, m."""
    free_cusps: Annotated[int, Field(ge=0)] = 4
    """Changes of direction without an extra cost."""
    many_cusps_cost: NotNegative = 0.4
    """Extra cost of each further change of direction, m: at each the truck stops and its errors add up."""
    swing_cost: NotNegative = 0.01
    """Cost of a change of curvature, m: few long arcs instead of many short ones."""
    crab_cost: AtLeastOne = 1.0
    """Cost of a metre of translation, m."""
    clearance: NotNegative = 0.1
    """Distance to obstacles below which a metre costs more, m."""
    clearance_cost: NotNegative = 0.1
    """Extra cost of a metre in contact, falling to 0 at ``clearance``, m."""
    tilt_cost: NotNegative = 2.0
    """Extra cost of a metre for each radian of tilt, m."""
    roughness_cost: NotNegative = 100.0
    """Extra cost of a metre for each metre of roughness, m."""


class HybridConfig(DriveCosts):
    """Hybrid-A* with improvement until the budget is used up."""

    kind: Literal["hybrid"] = "hybrid"
    heuristic_weight: AtLeastOne = 2.0
    """Heuristic weight: a greater one finds a first route sooner."""
    narrow_margin: NotNegative = 0.03
    """Least margin, used where the configured one leaves no path, m."""
    improve: bool = True
    """Smooth the route and try alternatives while there is time."""


class LatticeConfig(DriveCosts):
    """State lattice with motion primitives of exact radius; costs as the author's."""

    kind: Literal["lattice"] = "lattice"
    cell: Positive = 0.05
    """Size of a cell, m."""
    turn_factor: AtLeastOne = 2.0
    """On the cost of a turn forward."""
    reverse_factor: AtLeastOne = 3.0
    """On the cost of a metre backward."""
    reverse_turn_factor: AtLeastOne = 5.0
    """On the cost of a turn or translation backward."""
    heuristic_weight: AtLeastOne = 2.0
    """Heuristic weight of the first search; it falls to 1 while there is time."""


class GridAstarConfig(GoalConfig):
    """The author's first planner; its paths are no drivable motions."""

    kind: Literal["grid_astar"] = "grid_astar"
    neutral: Positive = 50.0
    """Cost of a free cell."""
    cost_factor: NotNegative = 3.0
    """On the costmap's value of a cell, 0 to 252."""
    lethal: Positive = 200.0
    """Costmap value from which on a cell is closed."""
    inflation: NotNegative = 0.3
    """Distance beyond the inscribed circle at which the costs of obstacles end, m."""
    decay: Positive = 10.0
    """Decay of the costs with distance, 1/m."""
