"""Settings of the local planners: light models, one ``kind`` each."""

from typing import Annotated, Literal

from pydantic import Field

from monstertruck_schemas.base import NotNegative, Positive, Schema

Count = Annotated[int, Field(gt=0)]

Strategy = Literal["start_to_end", "start_to_next", "point_to_point", "skip_failures", "start_to_receding_end"]


class BandConfig(Schema):
    """Elastic band."""

    overlap: Annotated[float, Field(gt=0, le=1)] = 0.7
    """Maximum distance of touching bubbles, as a share of the sum of their radii."""
    internal_gain: NotNegative = 1.0
    """Gain of the attraction by both neighbours."""
    external_gain: NotNegative = 2.0
    """Gain of the repulsion by obstacles."""
    iterations: Count = 5
    """Number of sweeps over the band and back."""
    depth: Count = 5
    """Number of times that an overshooting step, or a gap, is halved."""
    overshoot: Positive = 0.75
    """Minimum share of the previous force above which a reversed force is an overshoot."""
    significant: Positive = 0.1
    """Minimum force of an overshoot."""
    tiny: Positive = 0.01
    """Bubbles up to this radius are in collision (m)."""
    largest: Positive = 0.4
    """Clearance beyond which obstacles exert no force (m)."""


class PeopleConfig(Schema):
    """Walking people near the robot."""

    speed: Positive = 0.25
    """Minimum speed of a walking person (m/s); slower objects are obstacles at their current places."""
    horizon: Annotated[float, Field(gt=0, le=5)] = 2.0
    """Time over which people are predicted along their motion (s)"""
    distance: NotNegative = 0.2
    """Distance from their predicted places (m)."""
    spread: NotNegative = 0.1
    """Growth of that distance with the prediction time (m/s)."""
    patience: Positive = 8.0
    """Maximum wait for people to pass (s); then the robot continues, and treats them as static obstacles."""


class LocalPlannerConfig(Schema):
    """Settings shared by all local planners."""

    band: BandConfig = BandConfig()
    margin: NotNegative = 0.02
    """Kept between footprint and obstacles (m)."""
    reach: Positive = 3.0
    """Length of the route regarded (m)."""
    inset: NotNegative = 0.1
    """Distance between the window's border and the circle around the footprint where the route is cut (m)."""
    effort: Count = 1100
    """Number of expanded nodes and smoothing trials of a local search, which bounds the time of a cycle."""
    reverse_cost: Annotated[float, Field(ge=1)] = 3.0
    """Cost of a metre backward, where the lidar does not look (m)."""
    cusp_cost: NotNegative = 0.3
    """Cost of a change of direction (m)."""
    crab_cost: Annotated[float, Field(ge=1)] = 1.05
    """Cost of a metre of translation (m)."""
    clearance_cost: NotNegative = 0.5
    """Extra cost of a metre in contact, falling to 0 where obstacles are 0.1 m away (m)."""
    shortest: Positive = 0.15
    """Minimum length of the free beginning of a blocked path for driving it (m)."""


class RsbandConfig(LocalPlannerConfig):
    """Elastic band, then Reeds-Shepp motions that join its poses, with the truck's own turning radius."""

    kind: Literal["rsband"] = "rsband"
    strategy: Strategy = "start_to_next"
    """Method that joins the poses of the band to a path."""
    sub_goal: Positive = 0.6
    """Length of band to the goal of ``start_to_next`` (m)."""
    spacing: Positive = 0.4
    """Distance between the band poses that are joined one by one (m)."""
    renew: Positive = 0.5
    """Share of a path's length below which the remaining path is replaced."""
    off_path: Positive = 0.1
    """A path is replaced when the truck is further away from it (m)."""


class PublishedConfig(LocalPlannerConfig):
    """The published planner: turning radius 1.0 m whatever the truck, states 0.3 m from obstacles, its known faults."""

    kind: Literal["rsband-as-published"] = "rsband-as-published"
    strategy: Strategy = "start_to_next"
    """Method that joins the poses of the band to a path."""
    sub_goal: Positive = 0.6
    """Length of band to the goal of ``start_to_next`` (m)."""
    radius: Positive = 1.0
    """Turning radius (m)."""
    inflation: Positive = 0.3
    """Radius of the inflation; states must lie outside of it (m)."""
    emergency: bool = True
    """Turn by 45 degrees and more if no path is found."""


class TebConfig(LocalPlannerConfig):
    """Timed elastic band: poses and time steps, by sparse least squares."""

    kind: Literal["teb"] = "teb"
    spacing: Positive = 0.1
    """Distance between the poses (m)."""
    iterations: Count = 8
    """Number of Gauss-Newton steps per cycle."""
    clearance: Positive = 0.1
    """Preferred between footprint and obstacles (m)."""
    obstacle_weight: Positive = 30.0
    """Weight of clearances below ``clearance``."""
    steering_weight: Positive = 200.0
    """Weight of axle angles beyond their limits."""
    rate_weight: Positive = 1.0
    """Weight of steering rates, speeds and accelerations beyond their limits."""
    smooth_weight: NotNegative = 0.02
    """Weight of changes of the axle angles."""
    crab_weight: NotNegative = 0.05
    """Weight of translation."""
    time_weight: Positive = 0.3
    """Weight of the time."""
    speed: Positive = 0.2
    """Forward (m/s)."""
    reverse_speed: Positive = 0.15
    """Backward (m/s)."""
    acceleration: Positive = 0.5
    """m/s^2."""
    steering_rate: Positive = 1.0
    """Maximum steering rate of an axle (rad/s)."""
