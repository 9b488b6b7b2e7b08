"""Simulated world settings; the defaults describe the truck.

These are the *true* values of the plant. The daemon has its own calibration: to create a hidden error, change a value
here only. ``noise: false`` keeps the physics and disables every random part.
"""

from math import pi, radians
from pathlib import Path
from typing import Annotated, Final, Literal, Self

from pydantic import Field, model_validator

from monstertruck_drivers.emulation import SIGMAS
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
    """Pulse of the straight servo arm (us)."""
    us_per_degree: float = -10.48
    """Pulse change per degree of servo angle (us)."""
    rate: Positive = 6.0
    """Maximum servo speed, rad/s (0.17 s for 60 degrees)."""
    dead_time: NotNegative = 0.0
    """Delay from a new pulse to the first movement (s)."""
    lag: NotNegative = 0.0
    """Time constant of the arm's movement (s); 0: the arm turns at its maximum speed"""
    dead_band_us: NotNegative = 2.0
    """Smallest pulse change that moves the servo (us)."""
    resolution_us: Positive = 1.0
    """Resolution of the servo's pulse measurement (us)."""
    left_stop_deg: Annotated[float, Field(gt=0, le=180)] = 45.0
    """Angle of the arm's mechanical stop on the left."""
    right_stop_deg: Annotated[float, Field(gt=0, le=180)] = 45.0
    """Angle of the arm's mechanical stop on the right."""


class MotorConfig(Schema):
    """Drive motor and drivetrain."""

    inverted: bool = True
    """Whether a positive controller speed drives the truck backwards."""
    ratio: Positive = 644.0
    """Motor turns per wheel turn."""
    lag: Positive = 0.02
    """Time constant of the controller's speed loop (s)."""
    drivetrain_lag: Positive = 0.08
    """Time constant of the wheels' response to the motor (wind-up of gears, shafts and tyres) (s)."""
    clutch_force: Positive = 25.0
    """Pull at the ground that makes the slipper clutch slip, N (less than the grip of 35 N: wheels never spin)."""
    coast_rpm_s: Positive = 30_000.0
    """Deceleration of the unpowered motor due to friction (rpm/s)."""
    torque_constant: Positive = 0.0127
    """Torque constant, Nm/A (24 V at 18000 rpm)."""
    efficiency: Annotated[float, Field(gt=0, le=1)] = 0.5
    """Efficiency of all gear stages together."""
    idle_current: NotNegative = 0.08
    """No-load current of the turning motor (A)."""
    peak_current: NotNegative = 2.0
    """Current limit of the controller, drawn by a blocked motor (A)."""
    rotor_inertia: NotNegative = 1e-6
    """Moment of inertia of the rotor, kg m^2."""
    winding_resistance: NotNegative = 2.0
    """Winding resistance (ohm)."""
    current_noise: NotNegative = 0.01
    """Standard deviation of the measured current (A)."""


class AxleConfig(Schema):
    """Linkage polynomials of one axle (rad), highest power first."""

    left_from_servo: Annotated[tuple[float, ...], Field(strict=False, min_length=2)]
    right_from_left: Annotated[tuple[float, ...], Field(strict=False, min_length=2)]


class LinkageConfig(Schema):
    """Linkage of both axles."""

    front: AxleConfig
    rear: AxleConfig

    @property
    def polynomials(self) -> SteeringPolynomials:
        """Return the steering polynomials for the kinematics.

        Raises:
            KinematicsError: the wheels do not follow their servo.
        """
        front, rear = (AxlePolynomials(a.left_from_servo, a.right_from_left) for a in (self.front, self.rear))
        return SteeringPolynomials(front, rear)


class SkidModelConfig(Schema):
    """Effects of a skid-steer robot that its body parameters do not cover."""

    wheel_gains: Annotated[tuple[Positive, ...], Field(strict=False)] = ()
    """Ratio of effective to nominal wheel radius for each shaft, as motors and wheels differ; empty: all 1"""
    reversal_turn: float = 0.0
    """Mean turn at each reversal of the direction of travel, left positive (rad)"""
    reversal_spread: NotNegative = 0.0
    """Standard deviation of ``reversal_turn`` (rad)"""
    drift_x: float = 0.0
    """Slide along x of the map frame while the wheels turn (m/s)"""
    drift_y: float = 0.0
    """Slide along y of the map frame while the wheels turn (m/s)"""


class SimTruckConfig(Schema):
    """Body, wheels and tyres.

    Tyre slip: an axle travels at its wheels' angle less ``slip_angle`` times its lateral acceleration (including
    gravity on a side slope). The body travels less far than the wheels roll, by a fraction ``slip_per_newton`` times
    the pull. Both slips have a slow random part. An unsteered wheel rolls along its own axis.
    """

    body: AnyBody = TruckBody()
    """Kind of robot, as in the daemon's ``body``"""
    dynamics: Literal["kinematic", "single_track"] = "kinematic"
    """Lateral dynamics of a body with steered axles: slip angles, or the single-track model with inertia (linear tyres,
    blended into rolling below 0.15 m/s), where the stiffnesses replace the slip angles."""
    yaw_inertia: Positive = 0.20
    """Yaw moment of inertia, kg m^2; single-track model only"""
    front_stiffness: Positive = 120.0
    """Cornering stiffness of the front axle's tyres, N/rad; single-track model only"""
    rear_stiffness: Positive = 120.0
    """Cornering stiffness of the rear axle's tyres, N/rad; single-track model only"""
    wheelbase: Positive = 0.32
    """Wheelbase (m)."""
    track: Positive = 0.26
    """Track (m)."""
    wheel_radius: Positive = 0.075
    """Wheel radius (m)."""
    length: Positive = 0.47
    """Length of the footprint, centred on the geometric centre (m)."""
    width: Positive = 0.34
    """Width of the footprint (m)."""
    mass: Positive = 7.25
    """Mass of the robot (kg)."""
    rolling_resistance: NotNegative = 0.05
    """Rolling resistance as a fraction of the weight."""
    front_slip_angle: NotNegative = 0.06
    """Front slip angle per lateral acceleration, rad per m/s^2."""
    rear_slip_angle: NotNegative = 0.04
    """Rear slip angle per lateral acceleration, rad per m/s^2; less than in front: the truck understeers slightly."""
    slip_angle_noise: NotNegative = 0.004
    """Standard deviation of the random part of each axle's slip angle (rad)."""
    slip_per_newton: NotNegative = 0.0005
    """Longitudinal slip ratio per N of pull."""
    slip_noise: NotNegative = 0.005
    """Standard deviation of the random part of the longitudinal slip ratio."""
    steering: Literal["corrected", "as_published", "2016"] | LinkageConfig = "corrected"
    """Linkage polynomials: one of the published sets, or custom ones."""
    front_servo: ServoModelConfig = ServoModelConfig(channel=1)
    rear_servo: ServoModelConfig = ServoModelConfig(channel=0)
    front_right_servo: ServoModelConfig | None = None
    """Servo of the front right wheel if every wheel has its own servo; ``front_servo`` is then the front left servo."""
    rear_right_servo: ServoModelConfig | None = None
    """Servo of the rear right wheel; ``rear_servo`` is then the rear left servo."""
    motor: MotorConfig = MotorConfig()
    """Parameters of each motor"""
    skid: SkidModelConfig = SkidModelConfig()
    """Slip of a skid-steer body"""

    def chassis(self) -> Chassis:
        """Return the true kinematics.

        Raises:
            KinematicsError: the dimensions are impossible.
        """
        drivetrain = DriveTrain(self.motor.ratio, self.wheel_radius)
        polynomials = self.steering.polynomials if isinstance(self.steering, LinkageConfig) else self.steering
        chassis: Chassis = build_chassis(self.body, Dimensions(drivetrain, self.wheelbase, self.track, polynomials))
        return chassis

    @property
    def servos(self) -> tuple[ServoModelConfig, ...]:
        """Steering servos: front and rear, or front left, front right, rear left and rear right."""
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
            raise ValueError(f"dynamics single_track: body {self.body.kind} has no steered axles for curves")
        return self


class MechanicsConfig(Schema):
    """Masses, springs and friction of the truck for engine ``mujoco``; the total mass is ``truck.mass``."""

    wheel_mass: Positive = 0.281
    """Mass of one wheel (kg)."""
    axle_mass: Positive = 0.45
    """Mass of one axle without its wheels (kg)."""
    mass_height: Positive = 0.12
    """Height of the centre of the sprung mass above the ground (m)."""
    wheel_width: Positive = 0.08
    """Width of a wheel (m)."""
    droop: Positive = 0.010
    """Downward travel of an axle from its rest position to its stop (m)."""
    bump: Positive = 0.030
    """Upward travel of an axle from its rest position to its stop (m)."""
    damping: Positive = 0.35
    """Damping ratio of the suspension (1: critical)."""
    axle_roll_deg: Annotated[float, Field(gt=0, le=45)] = 10.0
    """Maximum roll of an axle relative to the chassis (degrees)."""
    friction: Positive = 0.5
    """Friction coefficient between tyres and ground."""
    tyre_stiffness: NotNegative = 60.0
    """Force of one rolling tyre per slip angle, N/rad (half the axle stiffness of the single-track model), and per
    slip ratio, N, for small slip; 0: rigid wheels"""
    relaxation: Annotated[float, Field(ge=0.01)] = 0.04
    """Relaxation length of a tyre (m)"""


class BatteryModelConfig(Schema):
    """LiPo pack and its measurement."""

    cells: Annotated[int, Field(ge=1, le=14)] = 6
    """Cells in series."""
    capacity_ah: Positive = 5.0
    """Capacity (Ah)."""
    charge: Fraction = 0.95
    """Initial charge as a fraction of the capacity."""
    resistance: NotNegative = 0.08
    """Instantaneous resistance of cells and wiring (ohm)."""
    recovery_resistance: NotNegative = 0.04
    """Resistance behind the additional sag, which builds up and recovers with ``recovery_time`` (ohm)."""
    recovery_time: Positive = 20.0
    """Time constant of the additional sag (s)."""
    electronics_w: NotNegative = 25.0
    """Constant load of computer, sensors and hubs (W)."""
    divider: Positive = 10.0
    """Pack volts per volt at the analog input."""
    channel: Annotated[int, Field(ge=0, le=5)] = 5
    """Analog input of the servo controller."""
    analog_offset: float = 0.0
    """Offset at the analog input due to the voltage drop along the ground wire (V)."""
    filter_time: Positive = 0.1
    """Time constant of the divider's RC low-pass (s)."""
    analog_noise: NotNegative = 0.003
    """Standard deviation of the voltage at the analog input (V)."""
    current_channel: Annotated[int, Field(ge=0, le=5)] | None = None
    """Analog input with a Hall sensor of the current into the pack; null: none."""
    current_zero: float = 2.5
    """Voltage of that sensor at no current (V)."""
    volts_per_amp: Positive = 0.1
    """Sensitivity of that sensor, V/A."""


class LidarConfig(Schema):
    """True mount and faults of the lidar. The emulated device defines beam directions, rate and range."""

    x: float = 0.14
    """Distance of the mount ahead of the geometric centre (m)."""
    y: float = 0.0
    """Distance to the left of the geometric centre (m)."""
    yaw: float = 0.0
    """Direction of the middle beam, left positive (rad)."""
    pitch: float = 0.0
    """Pitch of the scanning plane on the mount, nose down positive (rad)."""
    roll: float = 0.0
    """Roll of the scanning plane on the mount, right side down positive (rad)."""
    height: Positive = 0.25
    """Height of the scanning plane above the ground (m)."""
    first_step: Annotated[int, Field(ge=0, le=768)] = 44
    """First measuring step of a URG-04LX, 0..768."""
    last_step: Annotated[int, Field(ge=0, le=768)] = 725
    """Last measuring step of a URG-04LX, 0..768."""
    min_range: NotNegative | None = None
    """Minimum range (m); null: from the device's data sheet."""
    max_range: Positive | None = None
    """Maximum range (m); null: from the device's data sheet."""
    accuracy_sigmas: Positive = SIGMAS
    """The data sheet's error bound in standard deviations."""
    dropout: Fraction = 0.002
    """Probability that a single beam fails."""
    wall_height: Positive = 0.6
    """Height of all walls in the map (m); beams tilted upwards may pass over them."""

    @model_validator(mode="after")
    def _check_order(self) -> Self:
        if self.first_step > self.last_step:
            raise ValueError(f"first_step {self.first_step} > last_step {self.last_step}")
        if self.min_range is not None and self.max_range is not None and self.min_range >= self.max_range:
            raise ValueError(f"min_range {self.min_range} m >= max_range {self.max_range} m")
        return self


class CameraConfig(Schema):
    """True mount, lens and noise of the webcam."""

    x: float = 0.18
    """Distance of the mount ahead of the geometric centre (m)."""
    y: float = 0.0
    """Distance to the left of the geometric centre (m)."""
    height: Positive = 0.25
    """Height above the ground (m)."""
    yaw: float = 0.0
    """Viewing direction, left positive (rad)."""
    pitch: float = 0.0
    """Pitch, downwards positive (rad)."""
    roll: float = 0.0
    """Roll, right side down positive (rad)."""
    field_of_view: Annotated[float, Field(gt=0.1, lt=2.5)] = radians(63.0)
    """Horizontal field of view of the lens without distortion (rad)."""
    k1: Annotated[float, Field(ge=-0.5, le=0.5)] = 0.0
    """Radial distortion coefficient, second order."""
    k2: Annotated[float, Field(ge=-0.5, le=0.5)] = 0.0
    """Radial distortion coefficient, fourth order."""
    noise: Annotated[float, Field(ge=0, le=50)] = 0.0
    """Standard deviation of the pixel noise, grey levels of 255."""
    brightness: Annotated[float, Field(gt=0, le=10)] = 1.0
    """Brightness of the image relative to the drawn one; values above 255 saturate."""
    gradient: Annotated[float, Field(ge=-1, le=1)] = 0.0
    """Relative change in brightness from the image's centre to its left edge; the opposite to its right edge."""
    blur: Annotated[float, Field(ge=0, le=10)] = 0.0
    """Standard deviation of the defocus, in pixels."""
    reach: Positive = 30.0
    """Maximum drawing distance (m)."""
    rendered: bool = False
    """Whether to render images in three dimensions with shadows (40 ms each in software); engine mujoco only."""


class TagConfig(Schema):
    """A 36h11 AprilTag in the world: upright, as on a wall, or lying flat."""

    tag: Annotated[int, Field(ge=0, le=586)]
    """Tag number."""
    x: float
    """x of the tag's centre in the map (m)."""
    y: float
    """y of the tag's centre in the map (m)."""
    z: float = 0.25
    """Height above the ground (m)."""
    yaw: float = 0.0
    """Direction that the tag faces (rad); for a tag lying flat, the direction of its upper edge."""
    size: Annotated[float, Field(gt=0.01, le=1)] = 0.1
    """Side of the black square (m)."""
    lies: bool = False
    """Whether the tag lies, facing upwards."""


class ChargerConfig(Schema):
    """Charging contacts on the ground, too low for lidar and camera to see, with the robot's charging pose."""

    x: float
    """x of the robot's geometric centre on the contacts (m)."""
    y: float
    """y of the robot's geometric centre on the contacts (m)."""
    yaw: float = 0.0
    """Heading of the robot (rad)."""
    tolerance: Positive = 0.015
    """Maximum distance from the charging pose at which the contacts close (m)."""
    turn_tolerance: Positive = 0.035
    """Maximum heading error at which the contacts close (rad)."""
    current: NotNegative = 3.0
    """Charging current (A); 0: the charger is off."""


class HeldBoard(BoardConfig):
    """A ChArUco board that a person holds in front of a camera, changing its pose at intervals."""

    hold: Annotated[float, Field(ge=0.05, le=60)] = 1.5
    """Duration of each pose (s)"""
    printed_scale: Annotated[float, Field(gt=0.1, lt=10)] = 1.0
    """Ratio of the true board size to the sizes above"""


class RoofTag(Schema):
    """An AprilTag lying on the robot, with its upper edge towards the front; visible only in three dimensions."""

    tag: Annotated[int, Field(ge=0, le=586)]
    """Number of the tag in its family."""
    x: float = 0.0
    """Distance of the tag's centre ahead of the geometric centre (m)."""
    y: float = 0.0
    """Distance to the left of the geometric centre (m)."""
    z: float = 0.3
    """Height above the ground (m)."""
    size: Annotated[float, Field(gt=0.01, le=1)] = 0.08
    """Side of the black square (m)."""


class Iron(Schema):
    """Magnetic error due to the truck's metal: measured = soft * true + hard for each device axis x, y, z."""

    hard_x: float = 0.0
    """Hard-iron offset in x, mG."""
    hard_y: float = 0.0
    """Hard-iron offset in y, mG."""
    hard_z: float = 0.0
    """Hard-iron offset in z, mG."""
    soft_x: float = 1.0
    """Scale of the field in x."""
    soft_y: float = 1.0
    """Scale of the field in y."""
    soft_z: float = 1.0
    """Scale of the field in z."""
    soft_xy: float = 0.0
    """Fraction of the x field measured in y, and of the y field in x."""


class CompassModelConfig(Schema):
    """OS4000 on the body; its axes are x forward, y left, z up."""

    north_yaw: float = 1.5707963267948966
    """Direction of magnetic north in the map frame (rad)."""
    horizontal_field: Positive = 250.0
    """Horizontal field strength, mG."""
    vertical_field: float = -390.0
    """Vertical field, upwards positive, mG (northern hemisphere: downwards)."""
    deviation_deg: NotNegative = 0.4
    """Maximum of the deviation curve, which is fixed and varies smoothly with heading (degrees)."""
    noise_deg: NotNegative = 0.1
    """Standard deviation of heading, pitch and roll (degrees)."""
    tilt_bias_deg: NotNegative = 0.2
    """Maximum fixed error of pitch and of roll (degrees)."""
    motor_field: float = 5.0
    """Field along the device's y axis per ampere of motor current (mG/A); 1.1 degrees at 1 A."""
    temperature_c: float = 25.0
    """Temperature that the device reports, degrees Celsius."""
    iron: Iron = Iron()


class HornConfig(Schema):
    """Assembly of a lidar mount servo."""

    zero: float | None = None
    """Position (steps) at which the lidar is parallel to the body; None: from the driver settings."""
    direction: Literal[-1, 1] | None = None
    """+1 if a rising position turns the joint positively (REP 103); None: from the driver settings."""


class MountConfig(Schema):
    """Lidar mount with two servos."""

    pitch: HornConfig = HornConfig()
    roll: HornConfig = HornConfig()


class SonarPlace(Schema):
    """Sonar mount: position relative to the geometric centre (m) and direction of the axis (rad, left positive)."""

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
"""Left, front left, front, front right, right. FL is 0.05 m ahead of L, and L is 0.05 m left of the centre line; the
other values are assumptions."""


class SonarModelConfig(Schema):
    """Ultrasonic range finders.

    ``beam``: range along the axis to walls that reflect in all directions. ``cone``: nearest echo from anywhere in the
    cone. Walls act as mirrors for sound that hits them at more than ``critical_angle`` from the normal; edges and
    corners reflect in all directions. A sonar mistakes the sound of another sonar for its own.
    """

    model: Literal["beam", "cone"] = "cone"
    """Model of the echoes."""
    field_of_view: Annotated[float, Field(gt=0, lt=3)] = 0.87
    """Full opening angle of the cone (rad)."""
    range_min: NotNegative = 0.15
    """Minimum range (m); closer objects are reported at this range."""
    range_max: Positive = 3.0
    """Maximum range (m)."""
    noise: NotNegative = 0.005
    """Standard deviation of a range (m)."""
    noise_share: NotNegative = 0.01
    """Range-proportional standard deviation, as a fraction of the range; added to ``noise`` in quadrature."""
    dropout: Fraction = 0.0
    """Probability that an echo is missed."""
    critical_angle: Annotated[float, Field(gt=0, le=1.5708)] = 0.45
    """Maximum angle from a wall's normal at which sound returns (rad); ``cone`` only."""
    cross_talk: bool = True
    """Whether a sonar hears the pings of others; ``cone`` only."""
    audible: Positive = 6.0
    """Maximum distance (m) of a wall with an audible echo; echoes from beyond ``range_max`` may meet the next ping."""
    sonars: dict[FrameId, SonarPlace] = FIVE_SONARS
    """Sonar mounts by name."""
    height: NotNegative = 0.12
    """Height of all sonars above the ground (m); on a tilted body, some sonars look over the walls."""

    @model_validator(mode="after")
    def _check_order(self) -> Self:
        if not self.range_min < self.range_max <= self.audible:
            raise ValueError(
                f"range_min {self.range_min} m, range_max {self.range_max} m, audible {self.audible} m: "
                "expected increasing values"
            )
        return self


class ImuModelConfig(Schema):
    """IMU at the geometric centre; axes x forward, y left, z up."""

    rate_noise: NotNegative = 0.003
    """Standard deviation of each angular velocity (rad/s)."""
    rate_bias: NotNegative = 0.01
    """Maximum fixed error of each angular velocity (rad/s)."""
    rate_scale: Positive = 1.0
    """Scale factor of the measured rate about z."""
    acceleration_noise: NotNegative = 0.05
    """Standard deviation of each acceleration (m/s^2)."""
    acceleration_bias: NotNegative = 0.1
    """Maximum fixed error of each acceleration (m/s^2)."""
    temperature_c: float = 30.0
    """Temperature that the device reports, degrees Celsius."""


class GroundTilt(Schema):
    """Level ground, or the ground profile in the map's folder."""

    kind: Literal["ground"] = "ground"


class RoughPatch(Schema):
    """A rectangle of rough ground: waves along x and y, added to the ground height."""

    x: float
    """x of the centre (m)."""
    y: float
    """y of the centre (m)."""
    length: Positive = 1.0
    """Length along x (m)."""
    width: Positive = 1.0
    """Width along y (m)."""
    height: Positive = 0.02
    """Amplitude (m)."""
    wavelength: Positive = 0.45
    """Wavelength (m)."""


class SinusoidTilt(Schema):
    """Sinusoidal rocking of the body, on any ground."""

    kind: Literal["sinusoid"]
    pitch_deg: float = 15.0
    """Pitch amplitude, nose down positive (degrees)."""
    roll_deg: float = 0.0
    """Roll amplitude, right side down positive (degrees); lags pitch by a quarter period."""
    frequency: Positive = 0.5
    """Frequency (Hz)."""


class SteadyTilt(Schema):
    """Constant tilt of a body on blocks, on any ground."""

    kind: Literal["steady"]
    pitch_deg: float = 0.0
    """Pitch, nose down positive (degrees)."""
    roll_deg: float = 0.0
    """Roll, right side down positive (degrees)."""


TiltConfig = Annotated[GroundTilt | SinusoidTilt | SteadyTilt, Field(discriminator="kind")]


class Spot(Schema):
    """Position in the map frame (m)."""

    x: float
    y: float


class PersonConfig(Schema):
    """A person who walks through the world, modelled as an upright cylinder."""

    waypoints: Annotated[tuple[Spot, ...], Field(strict=False)] = ()
    """Way-points, walked in a loop from the first. Empty: random, from the seed"""
    speed: Annotated[float, Field(gt=0, le=3)] = 0.8
    """Mean speed (m/s); each leg is up to a fifth slower or faster"""
    radius: Annotated[float, Field(gt=0, le=1)] = 0.2
    """Radius of the cylinder (m)"""
    pause: NotNegative = 2.0
    """Mean pause at a way-point (s)"""
    distance: NotNegative = 0.8
    """Distance kept from robots and other people ahead (m)"""
    before: Literal["stop", "turn", "walk_on"] = "stop"
    """Reaction to a robot or person ahead: stop, then turn back after 3 s; turn aside; or keep walking until contact"""

    @model_validator(mode="after")
    def _somewhere(self) -> Self:
        if len(self.waypoints) == 1:
            raise ValueError("waypoints: expected two or more, or none for random ones")
        return self


class Hills(Schema):
    """Smooth random ground with its own seed: hills, or the roughness of a meadow with a short wavelength."""

    kind: Literal["hills"]
    height: NotNegative = 0.05
    """Standard deviation of the height (m)."""
    wavelength: Annotated[float, Field(ge=0.15)] = 2.0
    """Shortest wavelength (m)."""
    seed: Annotated[int, Field(ge=0)] = 1
    """Seed of the ground."""
    flat: NotNegative = 0.5
    """Radius of level ground around the start of every robot in the world (m)."""


class Slope(Schema):
    """An inclined plane between two levels: a ramp, or the side of a hill."""

    kind: Literal["slope"]
    x: float = 0.0
    """x of the foot of the slope (m)."""
    y: float = 0.0
    """y of the foot of the slope (m)."""
    direction: float = 0.0
    """Uphill direction (rad)."""
    angle_deg: Annotated[float, Field(ge=-40, le=40)] = 10.0
    """Angle of the slope, uphill positive (degrees)."""
    length: Positive = 2.0
    """Horizontal length (m)."""


class UprightStep(Schema):
    """A box with upright sides on the ground: a step, a kerb, a threshold, a stone."""

    kind: Literal["step"]
    x: float
    """x of the centre (m)."""
    y: float
    """y of the centre (m)."""
    yaw: float = 0.0
    """Yaw (rad)."""
    length: Positive = 0.1
    """Length (m)."""
    width: Positive = 1.0
    """Width (m)."""
    height: Positive = 0.03
    """Height (m)."""


class Ditch(Schema):
    """A straight furrow with sloping sides."""

    kind: Literal["ditch"]
    x: float
    """x of the centre (m)."""
    y: float
    """y of the centre (m)."""
    yaw: float = 0.0
    """Direction along the ditch (rad)."""
    length: Positive = 2.0
    """Length (m)."""
    width: Positive = 0.3
    """Width at the top (m)."""
    depth: Positive = 0.05
    """Depth (m)."""


class Rubble(Schema):
    """Flat stones scattered at random over a rectangle, with their own seed."""

    kind: Literal["rubble"]
    x: float = 0.0
    """x of the rectangle's centre (m)."""
    y: float = 0.0
    """y of the rectangle's centre (m)."""
    length: Positive = 2.0
    """Length along x (m)."""
    width: Positive = 2.0
    """Width along y (m)."""
    count: Annotated[int, Field(ge=1, le=200)] = 40
    """Number of stones."""
    height: Positive = 0.04
    """Height of the highest stone (m)."""
    size: Positive = 0.25
    """Longest side (m)."""
    seed: Annotated[int, Field(ge=0)] = 1
    """Seed of the stones."""


class HeightImage(Schema):
    """Heights from a greyscale image: black is 0, white is ``height``."""

    file: Path
    """PNG file, 8 or 16 bit"""
    resolution: Positive = 0.05
    """Side of a pixel (m)."""
    height: float = 1.0
    """Height of a white pixel (m)."""
    x: float = 0.0
    """x of the lower left corner (m)."""
    y: float = 0.0
    """y of the lower left corner (m)."""


GroundFeature = Annotated[Hills | Slope | UprightStep | Ditch | Rubble, Field(discriminator="kind")]


SOLID_BODIES: Final = ("truck", "ackermann", "skid_steer", "differential", "omni", "mecanum")
"""Bodies with a rigid-body model: the first three on the truck's axles, the others on individually sprung wheels."""


class WorldConfig(Schema):
    """One simulated world and one robot in it."""

    map: str = "loop"
    """Name of a built-in world, or path of a map_server YAML file (ground: ``NAME.profile.yaml`` next to it)."""
    start: Pose2D | None = None
    """Pose of the truck's geometric centre in the map frame; None: start of the built-in world, else the origin."""
    engine: Literal["plane", "mujoco"] = "plane"
    """Physics engine: kinematics in the plane, or rigid bodies in three dimensions (extra sim3d)."""
    noise: bool = True
    """Whether the sensors have noise."""
    truck: SimTruckConfig = SimTruckConfig()
    mechanics: MechanicsConfig = MechanicsConfig()
    battery: BatteryModelConfig = BatteryModelConfig()
    lidar: LidarConfig = LidarConfig()
    lidar_2: LidarConfig = LidarConfig(x=-0.14, yaw=pi)
    """True mount of the second lidar, which has no weight"""
    mount: MountConfig = MountConfig()
    camera: CameraConfig = CameraConfig()
    compass: CompassModelConfig = CompassModelConfig()
    sonar: SonarModelConfig = SonarModelConfig()
    imu: ImuModelConfig = ImuModelConfig()
    tilt: TiltConfig = GroundTilt()
    """Tilt of the body"""
    rough: Annotated[tuple[RoughPatch, ...], Field(strict=False)] = ()
    """Patches of rough ground"""
    ground: Annotated[tuple[GroundFeature, ...], Field(strict=False)] = ()
    """Features of uneven ground, summed; engine mujoco only"""
    height_image: HeightImage | None = None
    """Height image, added to the ground; engine mujoco only"""
    mjcf: Path | None = None
    """MJCF file with fixed geometries of the world; engine mujoco only"""
    people: Annotated[tuple[PersonConfig, ...], Field(strict=False, max_length=50)] = ()
    """People who walk through the world"""
    tags: Annotated[tuple[TagConfig, ...], Field(strict=False, max_length=500)] = ()
    """AprilTags in the world, visible to the camera; extra vision"""
    chargers: Annotated[tuple[ChargerConfig, ...], Field(strict=False, max_length=50)] = ()
    """Charging contacts of docks"""
    board: HeldBoard | None = None
    """Board held in front of the robot's camera, also visible to the lidar; null: no board; extra vision"""
    roof: RoofTag | None = None
    """A tag on the robot; engine mujoco only"""

    @model_validator(mode="after")
    def _check_engine(self) -> Self:
        if self.engine == "mujoco":
            if self.truck.body.kind not in SOLID_BODIES:
                raise ValueError(
                    f"engine mujoco: does not support body {self.truck.body.kind}; expected one of "
                    f"{', '.join(SOLID_BODIES)}"
                )
            if self.tilt.kind == "sinusoid":
                raise ValueError("engine mujoco: tilt sinusoid: not supported; expected ground or steady")
        elif self.roof is not None:
            raise ValueError("engine plane: no camera can see a tag on the robot; roof needs engine mujoco")
        elif self.camera.rendered:
            raise ValueError("engine plane: draws the camera's images itself; camera.rendered needs engine mujoco")
        elif self.ground or self.height_image is not None or self.mjcf is not None:
            raise ValueError("engine plane: has no ground, height_image or mjcf; expected engine mujoco")
        return self
