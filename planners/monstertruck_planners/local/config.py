"""Settings of the local planners: light models, one ``kind`` each."""

from typing import Annotated, Literal

from pydantic import Field

from monstertruck_schemas.base import NotNegative, Positive, Schema

Count = Annotated[int, Field(gt=0)]

Strategy = Literal["start_to_end", "start_to_next", "point_to_point", "skip_failures", "start_to_receding_end"]


class BandConfig(Schema):
    """Elastic band."""

    overlap: Annotated[float, Field(gt=0, le=1)] = 0.7
    """Maximum distance of touching bubbles, as a fraction of the sum of their radii."""
    internal_gain: NotNegative = 1.0
    """Gain of the attraction by both neighbours."""
    external_gain: NotNegative = 2.0
    """Gain of the repulsion by obstacles."""
    iterations: Count = 5
    """Number of forward and backward sweeps over the band."""
    depth: Count = 5
    """Number of times that an overshooting step, or a gap, is halved."""
    overshoot: Positive = 0.75
    """Minimum fraction of the previous force above which a reversed force is an overshoot."""
    significant: Positive = 0.1
    """Minimum force of an overshoot."""
    tiny: Positive = 0.01
    """Bubbles up to this radius are in collision (m)."""
    largest: Positive = 0.4
    """Clearance beyond which obstacles exert no force (m)."""


class PeopleConfig(Schema):
    """Walking people near the robot."""

    speed: Positive = 0.25
    """Minimum speed of a walking person (m/s); slower objects are obstacles at their current positions."""
    horizon: Annotated[float, Field(gt=0, le=5)] = 2.0
    """Time over which people are predicted along their motion (s)"""
    distance: NotNegative = 0.2
    """Minimum distance from predicted positions of people (m)."""
    spread: NotNegative = 0.1
    """Growth of that distance with the prediction time (m/s)."""
    patience: Positive = 8.0
    """Maximum wait for people to pass (s); then the robot continues, and treats them as static obstacles."""


class LocalPlannerConfig(Schema):
    """Settings shared by all local planners."""

    band: BandConfig = BandConfig()
    margin: NotNegative = 0.02
    """Minimum distance between footprint and obstacles (m)."""
    reach: Positive = 3.0
    """Length of the route that is considered (m)."""
    inset: NotNegative = 0.1
    """Distance of the footprint's circle from the window's border at which the route is cut (m)."""
    effort: Count = 1100
    """Number of expanded nodes and smoothing trials of a local search, which limits the time of a cycle."""
    reverse_cost: Annotated[float, Field(ge=1)] = 3.0
    """Cost of a metre in reverse, where the lidar has no view (m)."""
    cusp_cost: NotNegative = 0.3
    """Cost of a change of direction (m)."""
    crab_cost: Annotated[float, Field(ge=1)] = 1.05
    """Cost of a metre of translation (m)."""
    clearance_cost: NotNegative = 0.5
    """Extra cost of a metre in contact (m); it decreases to 0 at a clearance of 0.1 m."""
    shortest: Positive = 0.15
    """Minimum length of the free part of a blocked path for driving it (m)."""


class RsbandConfig(LocalPlannerConfig):
    """Elastic band whose poses are joined by Reeds-Shepp motions with the truck's own turning radius."""

    kind: Literal["rsband"] = "rsband"
    strategy: Strategy = "start_to_next"
    """Method that joins the poses of the band to a path."""
    sub_goal: Positive = 0.6
    """Length of the band up to the goal of ``start_to_next`` (m)."""
    spacing: Positive = 0.4
    """Distance between the band poses that are joined one by one (m)."""
    renew: Positive = 0.5
    """Fraction of a path's length below which the remaining path is replaced."""
    off_path: Positive = 0.1
    """Distance of the truck from a path above which the path is replaced (m)."""


class PublishedConfig(LocalPlannerConfig):
    """The published planner: turning radius 1.0 m for any truck, states 0.3 m from obstacles, and its known faults."""

    kind: Literal["rsband-as-published"] = "rsband-as-published"
    strategy: Strategy = "start_to_next"
    """Method that joins the poses of the band to a path."""
    sub_goal: Positive = 0.6
    """Length of the band up to the goal of ``start_to_next`` (m)."""
    radius: Positive = 1.0
    """Turning radius (m)."""
    inflation: Positive = 0.3
    """Inflation radius (m); states must be outside of it."""
    emergency: bool = True
    """Whether to turn by 45 degrees or more if no path is found."""


class TebConfig(LocalPlannerConfig):
    """Timed elastic band: poses and time steps, optimised by sparse least squares."""

    kind: Literal["teb"] = "teb"
    spacing: Positive = 0.1
    """Distance between the poses (m)."""
    iterations: Count = 8
    """Number of Gauss-Newton steps per cycle."""
    clearance: Positive = 0.1
    """Preferred distance between footprint and obstacles (m)."""
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
    """Maximum speed forward (m/s)."""
    reverse_speed: Positive = 0.15
    """Maximum speed in reverse (m/s)."""
    acceleration: Positive = 0.5
    """Maximum acceleration (m/s^2)."""
    steering_rate: Positive = 1.0
    """Maximum steering rate of an axle (rad/s)."""
