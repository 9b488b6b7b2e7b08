"""Robot bodies for the configurations of daemon and simulated world: drive families by ``kind``.

Lengths common to all robots (wheelbase, track, wheel radius, gear ratio) are in ``geometry``. Requests contain the
twist of the base, or its speed and two axle angles; a body without axles then follows the motion of the equivalent
bicycle with its ``wheelbase``. ``devices.drive`` is its first driven shaft, ``drive_2`` to ``drive_4`` are the others,
in this order.
"""

from typing import Annotated, Literal

from pydantic import Field

from monstertruck_schemas.base import Schema

Metres = Annotated[float, Field(gt=0, le=10)]
Gain = Annotated[float, Field(gt=0, le=10)]
Coefficient = Annotated[float, Field(ge=-2, le=2)]


HalfTurn = Annotated[float, Field(ge=-3.1416, le=3.1416)]
"""Angle up to half a turn, as people write it (rad)"""


class Mount(Schema):
    """Pose of a sensor in the base frame."""

    x: Annotated[float, Field(ge=-2, le=2)] = 0.0
    """Position forward of the base point, m"""
    y: Annotated[float, Field(ge=-2, le=2)] = 0.0
    """Position left of the base point, m"""
    z: Annotated[float, Field(ge=-2, le=2)] = 0.0
    """Height above the base point, m"""
    roll: HalfTurn = 0.0
    """Rotation about x, rad"""
    pitch: HalfTurn = 0.0
    """Rotation about y, rad"""
    yaw: HalfTurn = 0.0
    """Rotation about z, rad"""

    @property
    def planar(self) -> tuple[float, float, float]:
        """x, y (m) and yaw (rad)."""
        return self.x, self.y, self.yaw


class LensConfig(Schema):
    """Camera projection: a pinhole with Brown's distortion, nominal or calibrated."""

    width: Annotated[int, Field(ge=16, le=8192)] = 640
    """Image width at calibration, pixels; scaled for other widths"""
    height: Annotated[int, Field(ge=16, le=8192)] = 480
    """Image height at calibration, pixels"""
    focal_x: Annotated[float, Field(gt=10, le=20_000)] = 522.2
    """Horizontal focal length, pixels; nominal: 63 degrees across 640 pixels"""
    focal_y: Annotated[float, Field(gt=10, le=20_000)] = 522.2
    """Vertical focal length, pixels"""
    centre_x: Annotated[float, Field(ge=0, le=8192)] = 319.5
    """Principal point x, pixels; 0 is the centre of the first pixel"""
    centre_y: Annotated[float, Field(ge=0, le=8192)] = 239.5
    """Principal point y, pixels"""
    k1: Coefficient = 0.0
    """Radial distortion, second order"""
    k2: Coefficient = 0.0
    """Radial distortion, fourth order"""
    k3: Coefficient = 0.0
    """Radial distortion, sixth order"""
    p1: Coefficient = 0.0
    """Tangential distortion, first coefficient"""
    p2: Coefficient = 0.0
    """Tangential distortion, second coefficient"""


class BodyConfig(Schema):
    """Settings specific to one kind of body; each kind is a subclass."""

    kind: str


class TurnDeficitConfig(Schema):
    """Shortfall of the turn compared with the linkage; dimensionless, 0: none.

    The tangent t of an axle angle becomes t (1 - c t^2), with a coefficient c for each axle and steering side; where
    the axles oppose each other, the turn becomes turn (1 + c t_front t_rear), with a coefficient for each direction of
    turn.
    """

    front_left: Coefficient = 0.0
    front_right: Coefficient = 0.0
    rear_left: Coefficient = 0.0
    rear_right: Coefficient = 0.0
    counter_left: Coefficient = 0.0
    counter_right: Coefficient = 0.0


class TruckBody(BodyConfig):
    """Two steered axles, one motor for all four wheels."""

    kind: Literal["truck"] = "truck"
    turn_deficit: TurnDeficitConfig = TurnDeficitConfig()
    """Measured by circles in both directions, with each axle alone and with both"""


class AckermannBody(BodyConfig):
    """A car: steered front axle, fixed rear axle with the motor; the front servo steers."""

    kind: Literal["ackermann"]


class BicycleBody(BodyConfig):
    """One steered front wheel, one fixed rear wheel; the front servo steers."""

    kind: Literal["bicycle"]
    driven: Literal["front", "rear"] = "rear"
    """Wheel driven by the motor"""


class TricycleBody(BodyConfig):
    """One steered front wheel, two fixed rear wheels; the front servo steers."""

    kind: Literal["tricycle"]
    driven: Literal["front", "rear"] = "front"
    """Axle driven by the motor"""


class IndependentBody(BodyConfig):
    """A motor in every wheel: front left, front right, rear left, rear right."""

    kind: Literal["independent"]
    steering: Literal["axles", "wheels"] = "axles"
    """Two steered axles with ideal linkages, or a servo for every wheel"""


class DifferentialBody(BodyConfig):
    """Two driven wheels, left and right of the base point, and casters; nothing is steered."""

    kind: Literal["differential"]


class SkidSteerBody(BodyConfig):
    """Left and right wheels driven side by side (left, right), turning by skidding; parameters as identified."""

    kind: Literal["skid_steer"]
    motors: Literal["sides", "wheels"] = "sides"
    """One motor per side, or one per wheel: front left, front right, rear left, rear right"""
    icr_left: float | None = None
    """Lateral position of the left side's turning centre, m; default half the track, i.e. without skidding"""
    icr_right: float | None = None
    """Lateral position of the right side's turning centre, m"""
    icr_x: float = 0.0
    """Longitudinal position of the turning centres, m, behind the base (0 to -wheelbase)"""
    gain_left: Gain = 1.0
    """Effective over nominal radius of the left wheels"""
    gain_right: Gain = 1.0
    """Effective over nominal radius of the right wheels"""


class SynchroBody(BodyConfig):
    """Wheels that all roll (one motor) and turn (the front servo) together; the body keeps its heading."""

    kind: Literal["synchro"]


class OmniBody(BodyConfig):
    """Driven 90-degree Swedish wheels on a circle, counter-clockwise from the one straight ahead."""

    kind: Literal["omni"]
    circle: Metres = 0.2
    """Radius of the circle, m"""
    count: Annotated[int, Field(ge=3, le=4)] = 3
    """Number of wheels"""


class MecanumBody(BodyConfig):
    """Four driven mecanum wheels: front left, front right, rear left, rear right."""

    kind: Literal["mecanum"]
