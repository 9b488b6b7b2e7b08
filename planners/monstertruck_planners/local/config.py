"""Settings of the deformers: light models, one ``kind`` each."""

from typing import Annotated, Literal

from pydantic import Field

from monstertruck_schemas.base import Schema

Positive = Annotated[float, Field(gt=0)]
NotNegative = Annotated[float, Field(ge=0)]
Count = Annotated[int, Field(gt=0)]

Strategy = Literal["start_to_end", "start_to_next", "point_to_point", "skip_failures", "start_to_receding_end"]


class BandConfig(Schema):
    """Elastic band."""

    overlap: Annotated[float, Field(gt=0, le=1)] = 0.7
    """Neighbouring bubbles touch if they are nearer than this share of the sum of their radii."""
    internal_gain: NotNegative = 1.0
    """Of the pull of both neighbours."""
    external_gain: NotNegative = 2.0
    """Of the push away from obstacles."""
    iterations: Count = 5
    """Sweeps there and back."""
    depth: Count = 5
    """Times a step that overshoots is halved, and a gap is."""
    overshoot: Positive = 0.75
    """A force that turned round has overshot if it is greater than this share of the one before."""
    significant: Positive = 0.1
    """Smaller forces do not overshoot."""
    tiny: Positive = 0.01
    """Bubbles up to this radius do not count, m."""
    largest: Positive = 0.4
    """Clearance beyond which obstacles do not matter, m."""


class DeformConfig(Schema):
    """What all deformers share."""

    band: BandConfig = BandConfig()
    margin: NotNegative = 0.02
    """Kept between footprint and obstacles, m."""
    reach: Positive = 3.0
    """Length of the route looked at, m."""
    inset: NotNegative = 0.1
    """Kept between the window's border and the circle round the footprint where the route is cut, m."""
    effort: Count = 1100
    """Search steps and improvement trials of a local search: bounds the time of a cycle."""
    reverse_cost: Annotated[float, Field(ge=1)] = 3.0
    """Of a metre backward, where the lidar does not look, m."""
    cusp_cost: NotNegative = 0.3
    """Of a change of direction, m."""
    crab_cost: Annotated[float, Field(ge=1)] = 1.05
    """Of a metre beside the heading, m."""
    clearance_cost: NotNegative = 0.5
    """Extra cost of a metre in contact, falling to 0 where obstacles are 0.1 m away, m."""
    shortest: Positive = 0.15
    """A free beginning of a blocked path is used from this length on, m."""


class RsbandConfig(DeformConfig):
    """Elastic band, then Reeds-Shepp motions that join its poses, with the truck's own turning radius."""

    kind: Literal["rsband"] = "rsband"
    strategy: Strategy = "start_to_next"
    sub_goal: Positive = 0.6
    """Length of band to the pose aimed at by ``start_to_next``, m."""
    spacing: Positive = 0.4
    """Of the band poses joined one by one, m."""
    renew: Positive = 0.5
    """A path is replaced when less than this share of its length is left."""
    off_path: Positive = 0.1
    """A path is replaced when the truck is further away from it, m."""


class PublishedConfig(DeformConfig):
    """The published planner: turning radius 1.0 m whatever the truck, states 0.3 m from obstacles, its known faults."""

    kind: Literal["rsband-as-published"] = "rsband-as-published"
    strategy: Strategy = "start_to_next"
    sub_goal: Positive = 0.6
    radius: Positive = 1.0
    """Turning radius, m."""
    inflation: Positive = 0.3
    """Radius of the inflation; states must lie outside of it, m."""
    emergency: bool = True
    """Turn on the spot by 45 degrees and more when nothing else is found."""


class TebConfig(DeformConfig):
    """Timed elastic band: poses and time steps, by sparse least squares."""

    kind: Literal["teb"] = "teb"
    spacing: Positive = 0.1
    """Of the poses, m."""
    iterations: Count = 8
    """Gauss-Newton steps in one cycle."""
    clearance: Positive = 0.1
    """Wanted between footprint and obstacles, m."""
    obstacle_weight: Positive = 30.0
    steering_weight: Positive = 200.0
    """Of axle angles beyond their limits."""
    rate_weight: Positive = 1.0
    """Of steering, speeds and accelerations beyond their limits."""
    smooth_weight: NotNegative = 0.02
    """Of changes of the axle angles."""
    crab_weight: NotNegative = 0.05
    """Of travel beside the heading."""
    time_weight: Positive = 0.3
    """Of the time."""
    speed: Positive = 0.2
    """Forward, m/s."""
    reverse_speed: Positive = 0.15
    """Backward, m/s."""
    acceleration: Positive = 0.5
    """m/s^2."""
    steering_rate: Positive = 1.0
    """Of an axle, rad/s."""
