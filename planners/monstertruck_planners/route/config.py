"""Settings of the route planners: light models, one ``kind`` each."""

from typing import Annotated, Literal

from pydantic import Field

from monstertruck_schemas.base import Schema

Positive = Annotated[float, Field(gt=0)]
NotNegative = Annotated[float, Field(ge=0)]
AtLeastOne = Annotated[float, Field(ge=1)]

Unknown = Literal["blocked", "dear", "free"]


class GoalConfig(Schema):
    """What all route planners share."""

    budget: Positive = 1.0
    """Time for a route and its improvement, s; used when the caller gives a clock."""
    effort: Annotated[int, Field(gt=0)] = 60_000
    """Search steps and improvement trials allowed without a clock: equal inputs then give equal routes."""
    position_tolerance: NotNegative = 0.05
    """If the goal itself is taken, a free pose this near will do, m."""
    yaw_tolerance: NotNegative = 0.09
    """The same for the heading, rad."""
    margin: NotNegative = 0.0
    """Kept between footprint and obstacles, m."""
    unknown: Unknown = "blocked"
    """Cells that nobody has seen: obstacles, dear ground, or free."""
    unknown_cost: NotNegative = 1.0
    """Extra cost of a metre on dear unknown ground, m."""


class DriveCosts(GoalConfig):
    """What a metre costs, for planners of drivable motions. As they stand, routes are the shortest ones, nearly."""

    reverse_cost: AtLeastOne = 1.0
    """Of a metre backward, m; above 1 for a truck that sees better ahead."""
    cusp_cost: NotNegative = 0.1
    """Of a change of direction, m."""
    swing_cost: NotNegative = 0.01
    """Of a change of curvature, m: few long arcs rather than many short ones."""
    crab_cost: AtLeastOne = 1.0
    """Of a metre beside the heading, m."""
    clearance: NotNegative = 0.1
    """Nearer to obstacles than this a metre costs more, m."""
    clearance_cost: NotNegative = 0.1
    """Extra cost of a metre in contact, falling to 0 at ``clearance``, m."""
    tilt_cost: NotNegative = 2.0
    """Extra cost of a metre for each radian of tilt, m."""
    roughness_cost: NotNegative = 10.0
    """Extra cost of a metre for each metre of roughness, m."""


class HybridConfig(DriveCosts):
    """Hybrid-A* with improvement until the budget is used up."""

    kind: Literal["hybrid"] = "hybrid"
    greed: AtLeastOne = 2.0
    """Factor on the heuristics: more finds a first route sooner."""
    narrow_margin: NotNegative = 0.03
    """Kept instead of a greater margin where that leaves no way, m."""
    improve: bool = True
    """Shorten the route and look for other ways while there is time."""


class LatticeConfig(DriveCosts):
    """State lattice with moves of exact radius, made for the way of steering; costs as the author's."""

    kind: Literal["lattice"] = "lattice"
    cell: Positive = 0.05
    """Size of a cell, m."""
    turn_factor: AtLeastOne = 2.0
    """On the cost of a turn forward."""
    reverse_factor: AtLeastOne = 3.0
    """On the cost of a metre backward."""
    reverse_turn_factor: AtLeastOne = 5.0
    """On the cost of a turn or translation backward."""
    greed: AtLeastOne = 2.0
    """Factor on the heuristic of the first search; it falls to 1 while there is time."""


class GridAstarConfig(GoalConfig):
    """The author's first planner; its ways are no drivable motions."""

    kind: Literal["grid_astar"] = "grid_astar"
    neutral: Positive = 50.0
    """Cost of a free cell."""
    cost_factor: NotNegative = 3.0
    """On the costmap's value of a cell, 0 to 252."""
    lethal: Positive = 200.0
    """From this value on a cell is closed."""
    inflation: NotNegative = 0.3
    """Reach of the costs round obstacles beyond the inscribed circle, m."""
    decay: Positive = 10.0
    """Of the costs with distance, 1/m."""
