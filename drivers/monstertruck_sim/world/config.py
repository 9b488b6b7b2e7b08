"""Everything that can be chosen about the simulated world; the defaults are the truck's.

These are the *true* values of the plant. The daemon has its own calibration, so a hidden error
is made by changing a value here and not there. ``noise: false`` leaves the physics and drops every random part.
"""

from math import radians
from pathlib import Path
from typing import Annotated, Final, Literal, Self

from pydantic import Field, model_validator

from monstertruck_kinematics.chassis import Chassis, Dimensions
from monstertruck_kinematics.polynomials import AxlePolynomials, SteeringPolynomials
from monstertruck_kinematics.truck import DriveTrain
from monstertruck_runtime.bodies import AnyBody, build_chassis
from monstertruck_schemas.base import FrameId, NotNegative, Pose2D, Positive, Schema
from monstertruck_schemas.board import BoardConfig
from monstertruck_schemas.body import TruckBody

Fraction = Annotated[float, Field(ge=0, le=1)]


class ServoModelConfig(Schema):
    """One steering servo; a positive angle turns its wheels to the left."""

    channel: Annotated[int, Field(ge=0, le=5)]
    """Output of the servo controller."""
    centre_us: Positive = 1439.2
    """Pulse of the straight servo arm, us."""
    us_per_degree: float = -10.48
    """Pulse change per degree of servo angle, us."""
    rate: Positive = 6.0
    """Greatest servo speed, rad/s (0.17 s for 60 degrees)."""
    dead_time: NotNegative = 0.0
    """Delay from a new pulse to the first movement, s."""
    lag: NotNegative = 0.0
    """Time constant with which the arm then turns, s; 0: at its greatest speed"""
    dead_band_us: NotNegative = 2.0
    """The servo does not move for a smaller change of its pulse, us."""
    resolution_us: Positive = 1.0
    """Steps in which the servo measures its pulse, us."""
    left_stop_deg: Annotated[float, Field(gt=0, le=180)] = 45.0
    """Angle at which something stops the arm on its way to the left."""
    right_stop_deg: Annotated[float, Field(gt=0, le=180)] = 45.0


class MotorConfig(Schema):
    """Drive motor and what lies between it and the ground."""

    inverted: bool = True
    """The controller's positive sense drives the truck backwards."""
    ratio: Positive = 644.0
    """Motor turns per wheel turn."""
    lag: Positive = 0.02
    """Time constant of the controller's speed loop, s."""
    drivetrain_lag: Positive = 0.08
    """Time constant with which the wheels follow the motor (wind-up of gears, shafts and tyres), s."""
    clutch_force: Positive = 25.0
    """Pull at the ground at which the slipper clutch slips, N (less than the grip of 35 N: wheels never spin)."""
    coast_rpm_s: Positive = 30_000.0
    """Deceleration of the unpowered motor by friction, rpm/s."""
    torque_constant: Positive = 0.0127
    """Nm/A (24 V at 18000 rpm)."""
    efficiency: Annotated[float, Field(gt=0, le=1)] = 0.5
    """Efficiency of all gear stages together."""
    idle_current: NotNegative = 0.08
    """Current of the unloaded turning motor, A."""
    peak_current: NotNegative = 2.0
    """The controller's limit, which a motor that is held draws, A."""
    rotor_inertia: NotNegative = 1e-6
    """kg m^2."""
    winding_resistance: NotNegative = 2.0
    """Ohm."""
    current_noise: NotNegative = 0.01
    """Standard deviation of the measured current, A."""


class AxleConfig(Schema):
    """Linkage polynomials of one axle, rad, highest power first."""

    left_from_servo: Annotated[tuple[float, ...], Field(strict=False, min_length=2)]
    right_from_left: Annotated[tuple[float, ...], Field(strict=False, min_length=2)]


class LinkageConfig(Schema):
    """Linkage of both axles."""

    front: AxleConfig
    rear: AxleConfig

    @property
    def polynomials(self) -> SteeringPolynomials:
        """For the kinematics.

        Raises:
            KinematicsError: wheels that do not follow their servo.
        """
        front, rear = (AxlePolynomials(a.left_from_servo, a.right_from_left) for a in (self.front, self.rear))
        return SteeringPolynomials(front, rear)


class SkidModelConfig(Schema):
    """What a skid-steer robot does besides what its body's parameters say."""

    wheel_gains: Annotated[tuple[Positive, ...], Field(strict=False)] = ()
    """Effective over nominal radius of the wheel on every shaft: motors and wheels are not identical; empty = all 1"""
    reversal_turn: float = 0.0
    """Turn at each reversal of the direction of travel, on average, left positive, rad"""
    reversal_spread: NotNegative = 0.0
    """Its standard deviation, rad"""
    drift_x: float = 0.0
    """Slide of a robot whose wheels turn, in the map frame, m/s"""
    drift_y: float = 0.0
    """m/s"""


class SimTruckConfig(Schema):
    """Body, wheels and tyres.

    Tyre slip: an axle travels at its wheels' angle less ``slip_angle`` times its lateral acceleration (gravity on a
    side slope included); the body covers less ground than the wheels roll by ``slip_per_newton`` times the pull.
    Both carry a slow random part. A wheel that is not steered rolls along its own axis.
    """

    body: AnyBody = TruckBody()
    """Kind of robot, as the daemon's own ``body``"""
    dynamics: Literal["kinematic", "single_track"] = "kinematic"
    """How tyres hold a body with steered axles: by their slip angles, or with the inertia of the single-track model
    (linear tyres, blended into rolling below 0.15 m/s), whose stiffnesses then replace the slip angles."""
    yaw_inertia: Positive = 0.20
    """kg m^2; of the single-track model"""
    front_stiffness: Positive = 120.0
    """Cornering stiffness of the front axle's tyres, N/rad; of the single-track model"""
    rear_stiffness: Positive = 120.0
    """Cornering stiffness of the rear axle's tyres, N/rad; of the single-track model"""
    wheelbase: Positive = 0.32
    """m."""
    track: Positive = 0.26
    """m."""
    wheel_radius: Positive = 0.075
    """m."""
    length: Positive = 0.47
    """Length of the footprint, centred on the geometric centre, m."""
    width: Positive = 0.34
    """Width of the footprint, m."""
    mass: Positive = 7.25
    """kg."""
    rolling_resistance: NotNegative = 0.05
    """Rolling resistance as a share of the weight."""
    front_slip_angle: NotNegative = 0.06
    """rad per m/s^2."""
    rear_slip_angle: NotNegative = 0.04
    """rad per m/s^2; less than in front: the truck understeers a little."""
    slip_angle_noise: NotNegative = 0.004
    """Standard deviation of the random part of each axle's slip angle, rad."""
    slip_per_newton: NotNegative = 0.0005
    """Longitudinal slip ratio per N of pull."""
    slip_noise: NotNegative = 0.005
    """Standard deviation of the random part of the longitudinal slip ratio."""
    steering: Literal["corrected", "as_published", "2016"] | LinkageConfig = "corrected"
    """Linkage polynomials: a set of the sources', or a truck's own."""
    front_servo: ServoModelConfig = ServoModelConfig(channel=1)
    rear_servo: ServoModelConfig = ServoModelConfig(channel=0)
    front_right_servo: ServoModelConfig | None = None
    """Where every wheel has its own servo: the front right wheel's; ``front_servo`` is the front left one's."""
    rear_right_servo: ServoModelConfig | None = None
    """The rear right wheel's; ``rear_servo`` is the rear left one's."""
    motor: MotorConfig = MotorConfig()
    """Each of the motors"""
    skid: SkidModelConfig = SkidModelConfig()
    """Slip of a skid-steer body"""

    def chassis(self) -> Chassis:
        """True kinematics.

        Raises:
            KinematicsError: dimensions no robot can have.
        """
        drivetrain = DriveTrain(self.motor.ratio, self.wheel_radius)
        polynomials = self.steering.polynomials if isinstance(self.steering, LinkageConfig) else self.steering
        chassis: Chassis = build_chassis(self.body, Dimensions(drivetrain, self.wheelbase, self.track, polynomials))
        return chassis

    @property
    def servos(self) -> tuple[ServoModelConfig, ...]:
        """Front and rear, or front left, front right, rear left and rear right."""
        if self.front_right_servo is None or self.rear_right_servo is None:
            return self.front_servo, self.rear_servo
        return self.front_servo, self.front_right_servo, self.rear_servo, self.rear_right_servo

    @model_validator(mode="after")
    def _check_geometry(self) -> Self:
        if self.length < self.wheelbase or self.width < self.track:
            raise ValueError(
                f"footprint {self.length} m x {self.width} m: expected at least wheelbase x track, "
                f"{self.wheelbase} m x {self.track} m"
            )
        if self.front_servo.channel == self.rear_servo.channel:
            raise ValueError(f"front_servo and rear_servo share channel {self.front_servo.channel}")
        chassis = self.chassis()
        if self.skid.wheel_gains and len(self.skid.wheel_gains) != len(chassis.shafts):
            raise ValueError(
                f"skid.wheel_gains has {len(self.skid.wheel_gains)} values: expected one for each of the shafts "
                f"{', '.join(chassis.shafts)}"
            )
        if len({servo.channel for servo in self.servos}) < len(chassis.straight):
            raise ValueError(f"body {self.body.kind} has {len(chassis.straight)} servos: expected one channel for each")
        if self.dynamics == "single_track" and (chassis.linkage is None or chassis.freedom == "parallel"):
            raise ValueError(f"dynamics single_track: body {self.body.kind} has no axles that steer it into a curve")
        return self


class MechanicsConfig(Schema):
    """Masses, springs and friction of the truck, for engine ``mujoco``; the whole mass is ``truck.mass``."""

    wheel_mass: Positive = 0.281
    """Mass of one wheel, kg."""
    axle_mass: Positive = 0.45
    """Mass of one axle without its wheels, kg."""
    mass_height: Positive = 0.12
    """Height of the centre of the mass on the springs over the ground, m."""
    wheel_width: Positive = 0.08
    """m."""
    droop: Positive = 0.010
    """How far an axle sinks below its place at rest before its stop, m."""
    bump: Positive = 0.030
    """How far it rises before its stop, m."""
    damping: Positive = 0.35
    """Damping of the suspension as a share of the critical one."""
    axle_roll_deg: Annotated[float, Field(gt=0, le=45)] = 10.0
    """Greatest roll of an axle against the chassis."""
    friction: Positive = 0.5
    """Coefficient of friction between tyres and ground."""
    tyre_stiffness: NotNegative = 60.0
    """Force of one rolling tyre by a small slip angle, N/rad (half an axle's of the single-track model), and by a small
    slip ratio, N; 0: rigid wheels"""
    relaxation: Annotated[float, Field(ge=0.01)] = 0.04
    """Distance rolled in which a tyre's deflection gives way, m"""


class BatteryModelConfig(Schema):
    """LiPo pack and its measurement."""

    cells: Annotated[int, Field(ge=1, le=14)] = 6
    """Cells in series."""
    capacity_ah: Positive = 5.0
    charge: Fraction = 0.95
    """Charge at the start, as a share of the capacity."""
    resistance: NotNegative = 0.08
    """Resistance of cells and wiring, acts at once, ohm."""
    recovery_resistance: NotNegative = 0.04
    """Additional sag that builds up and recovers with ``recovery_time``, ohm."""
    recovery_time: Positive = 20.0
    """s."""
    electronics_w: NotNegative = 25.0
    """Constant load of computer, sensors and hubs, W."""
    divider: Positive = 10.0
    """Pack volts per volt at the analog input."""
    channel: Annotated[int, Field(ge=0, le=5)] = 5
    """Analog input of the servo controller."""
    analog_offset: float = 0.0
    """Added at the analog input by the drop along the ground wire, V."""
    filter_time: Positive = 0.1
    """Time constant of the divider's RC low-pass, s."""
    analog_noise: NotNegative = 0.003
    """Standard deviation at the analog input, V."""


class LidarConfig(Schema):
    """The lidar: its true mount and its faults. Directions, rate and range are those of the device that is emulated."""

    x: float = 0.14
    """Mount before the geometric centre, m."""
    y: float = 0.0
    """Distance to the left of the geometric centre, m."""
    yaw: float = 0.0
    """Direction of its middle beam, left positive, rad."""
    pitch: float = 0.0
    """Nose down positive, rad: its plane on the mount."""
    roll: float = 0.0
    """Right side down positive, rad."""
    height: Positive = 0.25
    """Height of the scanning plane over the ground, m."""
    first_step: Annotated[int, Field(ge=0, le=768)] = 44
    """First step of 0..768 at which a URG-04LX measures."""
    last_step: Annotated[int, Field(ge=0, le=768)] = 725
    """Its last one."""
    min_range: NotNegative | None = None
    """Shortest range, m; null: by the device's data sheet."""
    max_range: Positive | None = None
    """Longest range, m; null: by the device's data sheet."""
    accuracy_sigmas: Positive = 2.0
    """How many standard deviations the data sheet's bound on the error is."""
    dropout: Fraction = 0.002
    """Chance of a single beam to fail."""
    wall_height: Positive = 0.6
    """Height of everything in the map, m: beams tilted upwards pass over it."""

    @model_validator(mode="after")
    def _check_order(self) -> Self:
        if self.first_step > self.last_step:
            raise ValueError(f"first_step {self.first_step} > last_step {self.last_step}")
        if self.min_range is not None and self.max_range is not None and self.min_range >= self.max_range:
            raise ValueError(f"min_range {self.min_range} m >= max_range {self.max_range} m")
        return self


class CameraConfig(Schema):
    """The webcam: its true mount, lens and noise."""

    x: float = 0.18
    """Mount before the geometric centre, m."""
    y: float = 0.0
    """Distance to the left of the geometric centre, m."""
    height: Positive = 0.25
    """Over the ground, m."""
    yaw: float = 0.0
    """Direction in which it looks, left positive, rad."""
    pitch: float = 0.0
    """Downwards positive, rad."""
    roll: float = 0.0
    """Right side down positive, rad."""
    field_of_view: Annotated[float, Field(gt=0.1, lt=2.5)] = radians(63.0)
    """Horizontal, of the lens without its distortion, rad."""
    k1: Annotated[float, Field(ge=-0.5, le=0.5)] = 0.0
    """Radial distortion, second order."""
    k2: Annotated[float, Field(ge=-0.5, le=0.5)] = 0.0
    """Fourth order."""
    noise: Annotated[float, Field(ge=0, le=50)] = 0.0
    """Standard deviation of a pixel's grey, of 255."""
    reach: Positive = 30.0
    """Nothing farther away is drawn, m."""
    rendered: bool = False
    """Pictures are rendered in three dimensions, with shadows (40 ms each by software); engine mujoco only."""


class TagConfig(Schema):
    """An AprilTag of family 36h11 in the world: upright, as on a wall, or lying."""

    tag: Annotated[int, Field(ge=0, le=586)]
    """Its number."""
    x: float
    """Position of its middle in the map, m."""
    y: float
    """m."""
    z: float = 0.25
    """Over the ground, m."""
    yaw: float = 0.0
    """Direction that it faces, rad; of a lying one that of its upper edge."""
    size: Annotated[float, Field(gt=0.01, le=1)] = 0.1
    """Side of its black square, m."""
    lies: bool = False
    """It faces upwards."""


class HeldBoard(BoardConfig):
    """A ChArUco board that somebody holds before a camera, every while another way."""

    hold: Annotated[float, Field(ge=0.05, le=60)] = 1.5
    """Seconds for which it is held still"""
    printed_scale: Annotated[float, Field(gt=0.1, lt=10)] = 1.0
    """Size of the true board as a share of the sizes above"""


class RoofTag(Schema):
    """An AprilTag that lies on the robot, its upper edge towards the front; seen in three dimensions only."""

    tag: Annotated[int, Field(ge=0, le=586)]
    x: float = 0.0
    """Distance of its middle ahead of the geometric centre, m."""
    y: float = 0.0
    """Distance to the left of the geometric centre, m."""
    z: float = 0.3
    """Over the ground, m."""
    size: Annotated[float, Field(gt=0.01, le=1)] = 0.08
    """Side of its black square, m."""


class Iron(Schema):
    """Magnetic error of the truck's own metal: measured = soft * true + hard, per device axis x, y, z."""

    hard_x: float = 0.0
    """mG."""
    hard_y: float = 0.0
    """mG."""
    hard_z: float = 0.0
    """mG."""
    soft_x: float = 1.0
    soft_y: float = 1.0
    soft_z: float = 1.0
    soft_xy: float = 0.0
    """Share of x that shows in y, and of y in x."""


class CompassModelConfig(Schema):
    """OS4000 on the body; its axes are x forward, y left, z up."""

    north_yaw: float = 1.5707963267948966
    """Direction of magnetic north in the map frame, rad."""
    horizontal_field: Positive = 250.0
    """mG."""
    vertical_field: float = -390.0
    """Upwards, mG (northern hemisphere: down)."""
    deviation_deg: NotNegative = 0.4
    """Greatest error of a fixed smooth curve over the heading."""
    noise_deg: NotNegative = 0.1
    """Standard deviation of heading, pitch and roll."""
    tilt_bias_deg: NotNegative = 0.2
    """Greatest fixed error of pitch and of roll."""
    motor_field: float = 5.0
    """Field along the device's y per ampere of motor current, mG/A (1.1 degrees at 1 A)."""
    temperature_c: float = 25.0
    iron: Iron = Iron()


class HornConfig(Schema):
    """How a servo of the lidar's mount was put together."""

    zero: float | None = None
    """Position at which the lidar is parallel to the body, steps; None: as the driver's settings say."""
    direction: Literal[-1, 1] | None = None
    """+1 where a rising position turns the joint positively (REP 103); None: as the driver's settings say."""


class MountConfig(Schema):
    """The lidar's mount with its two servos."""

    pitch: HornConfig = HornConfig()
    roll: HornConfig = HornConfig()


class SonarPlace(Schema):
    """A sonar on the body: place from the geometric centre, m, and direction of its axis, rad, left positive."""

    x: float
    y: float
    yaw: float


FIVE_SONARS: dict[str, SonarPlace] = {
    "l": SonarPlace(x=0.05, y=0.05, yaw=1.5708),
    "fl": SonarPlace(x=0.10, y=0.05, yaw=0.7854),
    "f": SonarPlace(x=0.12, y=0.0, yaw=0.0),
    "fr": SonarPlace(x=0.10, y=-0.05, yaw=-0.7854),
    "r": SonarPlace(x=0.05, y=-0.05, yaw=-1.5708),
}
"""Left, front left, front, front right, right. FL is 0.05 m ahead of L, which is 0.05 m left of the middle; the other
values are chosen."""


class SonarModelConfig(Schema):
    """Ultrasonic range finders.

    ``beam``: range along the axis to walls that reflect in all directions. ``cone``: nearest echo from anywhere in the
    cone; walls are mirrors for sound that meets them at more than ``critical_angle`` from the normal, edges and corners
    reflect in all directions, and a sonar takes the sound of another one for its own.
    """

    model: Literal["beam", "cone"] = "cone"
    field_of_view: Annotated[float, Field(gt=0, lt=3)] = 0.87
    """Full opening angle of the cone, rad."""
    range_min: NotNegative = 0.15
    """Least range, m: what is nearer is reported as this range."""
    range_max: Positive = 3.0
    """Greatest range, m."""
    noise: NotNegative = 0.005
    """Standard deviation of a range, m."""
    noise_share: NotNegative = 0.01
    """Standard deviation that grows with the range, of the range; added to ``noise`` in quadrature."""
    dropout: Fraction = 0.0
    """Chance that an echo is missed."""
    critical_angle: Annotated[float, Field(gt=0, le=1.5708)] = 0.45
    """Greatest angle from a wall's normal at which sound comes back, rad; ``cone`` only."""
    cross_talk: bool = True
    """A sonar hears what others sent; ``cone`` only."""
    audible: Positive = 6.0
    """Farthest wall whose echo is heard, m: what comes back from beyond ``range_max`` may meet the next ping."""
    sonars: dict[FrameId, SonarPlace] = FIVE_SONARS
    """Mounts by name."""
    height: NotNegative = 0.12
    """Height of all sonars over the ground, m: on a body that leans some look over the walls."""

    @model_validator(mode="after")
    def _check_order(self) -> Self:
        if not self.range_min < self.range_max <= self.audible:
            raise ValueError(
                f"range_min {self.range_min} m, range_max {self.range_max} m, audible {self.audible} m: "
                "expected them to rise"
            )
        return self


class ImuModelConfig(Schema):
    """Gyroscopes and accelerometers at the geometric centre; axes x forward, y left, z up."""

    rate_noise: NotNegative = 0.003
    """Standard deviation of each angular velocity, rad/s."""
    rate_bias: NotNegative = 0.01
    """Greatest fixed error of each angular velocity, rad/s."""
    rate_scale: Positive = 1.0
    """Scale factor of the measured rate about z."""
    acceleration_noise: NotNegative = 0.05
    """Standard deviation of each axis, m/s^2."""
    acceleration_bias: NotNegative = 0.1
    """Greatest fixed error of each axis, m/s^2."""
    temperature_c: float = 30.0


class GroundTilt(Schema):
    """The ground is level, or follows the profile in the map's folder."""

    kind: Literal["ground"] = "ground"


class RoughPatch(Schema):
    """A rectangle of rough ground: waves along x and along y, added to the ground's height."""

    x: float
    """Position of its middle, m."""
    y: float
    """m."""
    length: Positive = 1.0
    """Along x, m."""
    width: Positive = 1.0
    """Along y, m."""
    height: Positive = 0.02
    """Amplitude, m."""
    wavelength: Positive = 0.45
    """m."""


class SinusoidTilt(Schema):
    """The body rocks with time, on any ground."""

    kind: Literal["sinusoid"]
    pitch_deg: float = 15.0
    """Amplitude, nose down positive."""
    roll_deg: float = 0.0
    """Amplitude, right side down positive; a quarter period after pitch."""
    frequency: Positive = 0.5
    """Hz."""


class SteadyTilt(Schema):
    """The body stands on blocks, on any ground."""

    kind: Literal["steady"]
    pitch_deg: float = 0.0
    """Nose down positive."""
    roll_deg: float = 0.0
    """Right side down positive."""


TiltConfig = Annotated[GroundTilt | SinusoidTilt | SteadyTilt, Field(discriminator="kind")]


class Spot(Schema):
    """A place in the map frame, m."""

    x: float
    y: float


class PersonConfig(Schema):
    """Somebody who walks through the world: an upright cylinder."""

    waypoints: Annotated[tuple[Spot, ...], Field(strict=False)] = ()
    """Walked to in turn, the first one again after the last one; the first is the start. Empty: drawn by the seed"""
    speed: Annotated[float, Field(gt=0, le=3)] = 0.8
    """m/s on average; every leg is up to a fifth slower or faster"""
    radius: Annotated[float, Field(gt=0, le=1)] = 0.2
    """m"""
    pause: NotNegative = 2.0
    """Seconds of standing at a way-point, on average"""
    distance: NotNegative = 0.8
    """Metres kept from robots and other people ahead"""
    before: Literal["stop", "turn", "walk_on"] = "stop"
    """What is done before them: stop and, after 3 s, turn back; turn aside; or walk on until they are touched"""

    @model_validator(mode="after")
    def _somewhere(self) -> Self:
        if len(self.waypoints) == 1:
            raise ValueError("waypoints: expected two or more, or none to have them drawn")
        return self


class Hills(Schema):
    """Random smooth ground, drawn by a seed of its own: hills, or with a short wave the roughness of a meadow."""

    kind: Literal["hills"]
    height: NotNegative = 0.05
    """Standard deviation, m."""
    wavelength: Annotated[float, Field(ge=0.15)] = 2.0
    """Shortest wave, m."""
    seed: Annotated[int, Field(ge=0)] = 1
    flat: NotNegative = 0.5
    """Radius of level ground around the start of every robot of the world, m."""


class Slope(Schema):
    """An inclined plane between two levels: a ramp, or the side of a hill."""

    kind: Literal["slope"]
    x: float = 0.0
    """Where it begins, m."""
    y: float = 0.0
    """m."""
    direction: float = 0.0
    """Direction in which it rises, rad."""
    angle_deg: Annotated[float, Field(ge=-40, le=40)] = 10.0
    length: Positive = 2.0
    """Length seen from above, m."""


class UprightStep(Schema):
    """A box with upright sides on the ground: a step, a kerb, a threshold, a stone."""

    kind: Literal["step"]
    x: float
    """Position of its middle, m."""
    y: float
    """m."""
    yaw: float = 0.0
    """rad."""
    length: Positive = 0.1
    """m."""
    width: Positive = 1.0
    """m."""
    height: Positive = 0.03
    """m."""


class Ditch(Schema):
    """A furrow with sloping sides, straight from one place to another."""

    kind: Literal["ditch"]
    x: float
    """Position of its middle, m."""
    y: float
    """m."""
    yaw: float = 0.0
    """Along it, rad."""
    length: Positive = 2.0
    """m."""
    width: Positive = 0.3
    """Width at the top, m."""
    depth: Positive = 0.05
    """m."""


class Rubble(Schema):
    """Flat stones scattered over a rectangle, drawn by a seed of its own."""

    kind: Literal["rubble"]
    x: float = 0.0
    """Position of its middle, m."""
    y: float = 0.0
    """m."""
    length: Positive = 2.0
    """Along x, m."""
    width: Positive = 2.0
    """Along y, m."""
    count: Annotated[int, Field(ge=1, le=200)] = 40
    height: Positive = 0.04
    """Height of the highest one, m."""
    size: Positive = 0.25
    """Longest side, m."""
    seed: Annotated[int, Field(ge=0)] = 1


class HeightImage(Schema):
    """Heights from a grey picture: black is 0, white is ``height``."""

    file: Path
    """PNG, 8 or 16 bit"""
    resolution: Positive = 0.05
    """Side of a pixel, m."""
    height: float = 1.0
    """m."""
    x: float = 0.0
    """Position of its lower left corner, m."""
    y: float = 0.0
    """m."""


GroundFeature = Annotated[Hills | Slope | UprightStep | Ditch | Rubble, Field(discriminator="kind")]


SOLID_BODIES: Final = ("truck", "ackermann", "skid_steer", "differential", "omni", "mecanum")
"""Bodies with rigid parts: the first three on the truck's axles, the others on wheels with springs of their own."""


class WorldConfig(Schema):
    """One simulated world, and one robot in it."""

    map: str = "loop"
    """Name of a built-in world, or path of a map_server YAML file (its ground: ``NAME.profile.yaml`` next to it)."""
    start: Pose2D | None = None
    """Pose of the truck's geometric centre in the map frame; None: the built-in world's own, else the origin."""
    engine: Literal["plane", "mujoco"] = "plane"
    """What moves the robot: kinematics in the plane, or rigid bodies in three dimensions (extra sim3d)."""
    noise: bool = True
    truck: SimTruckConfig = SimTruckConfig()
    mechanics: MechanicsConfig = MechanicsConfig()
    battery: BatteryModelConfig = BatteryModelConfig()
    lidar: LidarConfig = LidarConfig()
    mount: MountConfig = MountConfig()
    camera: CameraConfig = CameraConfig()
    compass: CompassModelConfig = CompassModelConfig()
    sonar: SonarModelConfig = SonarModelConfig()
    imu: ImuModelConfig = ImuModelConfig()
    tilt: TiltConfig = GroundTilt()
    rough: Annotated[tuple[RoughPatch, ...], Field(strict=False)] = ()
    """Patches of rough ground"""
    ground: Annotated[tuple[GroundFeature, ...], Field(strict=False)] = ()
    """What makes the ground uneven, added up; engine mujoco only"""
    height_image: HeightImage | None = None
    """A picture of the ground, added to it; engine mujoco only"""
    mjcf: Path | None = None
    """MJCF file whose geometries stand in the world and do not move; engine mujoco only"""
    people: Annotated[tuple[PersonConfig, ...], Field(strict=False, max_length=50)] = ()
    """Who walks through it"""
    tags: Annotated[tuple[TagConfig, ...], Field(strict=False, max_length=500)] = ()
    """AprilTags on its walls, seen by the camera; extra vision"""
    board: HeldBoard | None = None
    """Somebody holds it before the robot's camera, where the lidar sees it, too; null = nobody does; extra vision"""
    roof: RoofTag | None = None
    """A tag on the robot; engine mujoco only"""

    @model_validator(mode="after")
    def _check_engine(self) -> Self:
        if self.engine == "mujoco":
            if self.truck.body.kind not in SOLID_BODIES:
                raise ValueError(
                    f"engine mujoco: has no body {self.truck.body.kind}; expected one of {', '.join(SOLID_BODIES)}"
                )
            if self.tilt.kind == "sinusoid":
                raise ValueError("engine mujoco: tilt sinusoid: nothing rocks the robot; expected ground or steady")
        elif self.roof is not None:
            raise ValueError("engine plane: nothing sees a tag on the robot; roof needs engine mujoco")
        elif self.camera.rendered:
            raise ValueError("engine plane: draws the camera's pictures itself; camera.rendered needs engine mujoco")
        elif self.ground or self.height_image is not None or self.mjcf is not None:
            raise ValueError("engine plane: has no ground, height_image or mjcf; expected engine mujoco")
        return self
