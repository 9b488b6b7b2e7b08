"""Messages of the ``sensor`` group: measurements of the devices, in SI units, before any estimation."""

from enum import StrEnum
from typing import Annotated, ClassVar, Literal

from pydantic import ConfigDict, Field

from monstertruck_schemas.base import Float64Array, Message, Nanoseconds, Pose2D, Schema, UInt8Array, servos_of


class LaserScan(Message):
    """One lidar revolution: beam i at ``start_angle + i * angle_increment``, in the order of measurement.

    A scanner that turns clockwise has ``end_angle`` below ``start_angle``. ``stamp`` is the time of the first beam in
    ``ranges``; beam i is measured ``i * time_increment`` later. The number of beams may vary from scan to scan.
    """

    start_angle: float
    """Angle of the first beam, rad."""
    end_angle: float
    """Angle of the last beam, rad."""
    time_increment: Annotated[float, Field(ge=0)]
    """Seconds between neighbouring beams."""
    scan_time: Annotated[float, Field(gt=0)]
    """Seconds of one revolution."""
    range_min: Annotated[float, Field(ge=0)]
    """Minimum measurable range (m)."""
    range_max: Annotated[float, Field(gt=0)]
    """Maximum measurable range (m)."""
    ranges: Float64Array
    """Shape (n,), m; +inf where the beam has no valid return (see ``codes``)."""
    codes: UInt8Array
    """Shape (n,): ``VALID_BEAM``, a code up to ``NO_ECHO`` where the sensor saw nothing within its range, or another
    code of the sensor (see its manual) for an invalid beam."""
    intensities: UInt8Array | None = None
    """Shape (n,): intensity of the returns in the sensor's own unit, 0 without a return; None if not measured."""
    tilt: Annotated[float, Field(ge=0)] | None = None
    """Angle between the scanning plane and the horizontal in the middle of the scan (rad); None if not measured."""
    range_noise: Annotated[float, Field(ge=0, le=1)] | None = None
    """Standard deviation of a range close by (m), by the sensor's data sheet; None if it is not known."""

    @property
    def angle_increment(self) -> float:
        """Angle between consecutive beams (rad), negative if clockwise."""
        return (self.end_angle - self.start_angle) / max(len(self.ranges) - 1, 1)

    @property
    def field(self) -> tuple[float, float]:
        """Minimum and maximum bearing of a beam (rad)."""
        return min(self.start_angle, self.end_angle), max(self.start_angle, self.end_angle)


STANDARD_GRAVITY = 9.80665
"""1 g, the unit of accelerometers, m/s^2 (ISO 80000-3)."""
VALID_BEAM = 255
"""``LaserScan.codes`` value of a beam that measured a range."""
HIDDEN = 254
"""``LaserScan.codes`` value of a beam that a part of the robot hides, by the configuration."""
NO_ECHO = 2
"""Greatest ``LaserScan.codes`` value of a beam that met nothing within the sensor's range."""


class Vector3(Schema):
    """Three components in the message's frame."""

    x: float
    y: float
    z: float


class Attitude(Message):
    """Compass with tilt sensor."""

    heading: Annotated[float, Field(ge=0, lt=6.2831853072)]
    """Heading clockwise from magnetic north, rad, exactly as the device means it."""
    roll: float
    """Rotation about x (REP 103: left side up is positive), rad."""
    pitch: float
    """Rotation about y (REP 103: nose DOWN is positive), rad."""
    temperature: float | None = None
    """Board temperature, degree Celsius; crude."""
    magnetic_field: Vector3 | None = None
    """Magnetometer, microtesla where the unit was calibrated so."""
    acceleration: Vector3 | None = None
    """Accelerometer, m/s^2."""
    heading_disturbed: bool = False
    """Field strength differs from the calibrated one: do not trust the heading."""
    tilt_valid: bool = True
    """False while the acceleration is not near 1 g: roll and pitch are then not tilt."""
    degraded: bool = False
    """Whether it depends on an expired calibration."""


class DriveMode(StrEnum):
    """DS402 power states, reduced to the relevant ones."""

    DISABLED = "disabled"
    STARTING = "starting"
    ENABLED = "enabled"
    QUICK_STOP = "quick_stop"
    FAULT = "fault"


class DriveFeedback(Message):
    """State of the drive motor reported by its controller, at the motor shaft; forward is positive."""

    position: float
    """Motor shaft angle since start, rad, unwrapped."""
    velocity: float
    """Motor shaft speed, rad/s: averaged by the controller."""
    current: float | None = None
    """Motor current, A; None in messages that did not read it."""
    mode: DriveMode
    """State of the controller."""
    fault_code: int | None = None
    """Latest entry of the controller's error history while in fault."""
    supply_voltage: float | None = None
    """Voltage at the controller, V; None in messages that did not read it."""


class SteeringFeedback(Message):
    """Pulses currently sent by the servo controller, as servo angles; not measured positions."""

    front: float
    """Front servo angle, rad, left positive, 0 = straight ahead."""
    rear: float
    """Rear servo angle, rad, left positive, 0 = straight ahead."""
    front_right: float | None = None
    """Front right wheel, if every wheel has its own servo; ``front`` is then the front left wheel."""
    rear_right: float | None = None
    """Rear right wheel; ``rear`` is then the rear left wheel."""
    error_word: int = 0
    """Non-zero: the controller reported errors since the last read (its own bits)."""
    trusted: bool = True
    """False while the targets have to be sent again after an error or a restart."""

    @property
    def servos(self) -> tuple[float, ...]:
        """All servo angles: front and rear, or front left, front right, rear left and rear right."""
        return servos_of(self.front, self.front_right, self.rear, self.rear_right)


class BatteryLevel(StrEnum):
    """Judgement of the battery with hysteresis and dwell."""

    UNKNOWN = "unknown"
    NORMAL = "normal"
    LOW = "low"
    CRITICAL = "critical"
    OVERCHARGED = "overcharged"
    SENSOR_FAULT = "sensor_fault"


class Battery(Message):
    """Pack voltage and its judgement."""

    voltage: float | None = None
    """Filtered pack voltage, V; None while the sensor is at fault."""
    raw_voltage: float
    """Latest single sample (V)."""
    cells: int
    """Cells in series."""
    level: BatteryLevel
    """Judgement of the voltage."""
    rest_voltage: float | None = None
    """Filtered voltage the pack would show without the motor's current, V; None while the sensor is at fault."""
    cell_voltage: float | None = None
    """Mean of the cells at rest, V. One weak cell does not show in it."""
    charge: float | None = None
    """Share of the capacity that is left, 0..1, from the resting voltage: right to 0.1 at best."""
    capacity_ah: float | None = None
    """Capacity of the pack as configured, Ah."""
    current: float | None = None
    """Current into the pack, A: positive while it is charged; None if the robot does not measure it."""
    degraded: bool = False
    """Whether it depends on an expired calibration."""


class SonarEcho(Schema):
    """One sonar of an array. Its frame is ``sonar_<name>``, x along the axis of its cone."""

    name: str
    """Name of the sonar in its array."""
    answered: bool = True
    """False if the sonar is dead or lost; the space in front of it is then unknown."""
    range: Annotated[float, Field(gt=0)] | None = None
    """Distance to the nearest thing in the cone, at an unknown bearing within it, m; None without an echo. A sonar that
    answered without one has nothing before it, or a surface that reflected the sound elsewhere."""
    stamp: Nanoseconds
    """Time of the reflection; without an echo, time of the ping; of a silent sonar, time of the query."""


class SonarRanges(Message):
    """All sonars of the robot, each pinged once; ``stamp`` is the oldest of their stamps."""

    sonars: tuple[SonarEcho, ...]
    """Echoes in the order of the configuration."""
    field_of_view: Annotated[float, Field(gt=0, le=3.1416)]
    """Full opening angle of the cones, rad."""
    range_min: Annotated[float, Field(ge=0)]
    """Minimum range (m): nearer objects are reported at about this range, or not at all."""
    range_max: Annotated[float, Field(gt=0)]
    """Maximum range (m)."""
    degraded: bool = False
    """Whether it depends on an expired calibration."""

    def echo(self, name: str) -> SonarEcho | None:
        """Return the sonar of that name; None if the array has none."""
        return next((sonar for sonar in self.sonars if sonar.name == name), None)


class Imu(Message):
    """Inertial measurement unit with six degrees of freedom, in its own axes (REP 103: x forward, y left, z up)."""

    angular_velocity: Vector3
    """rad/s."""
    linear_acceleration: Vector3
    """Specific force, m/s^2: at rest and level, z is +9.81."""
    temperature: float | None = None
    """Temperature of the unit, degree Celsius."""


class WheelEncoders(Message):
    """Encoders of two free wheels, such as the rear wheels of a tricycle."""

    left: float
    """Angle of the left wheel since the driver's first reading, rad, unwrapped, forward positive."""
    right: float
    """Distance of the right wheel (m)."""


class HandControls(Message):
    """Sticks and switches of the operator's radio control, through the robot's receiver.

    ``stamp`` is the arrival of the latest channels. While the transmitter is lost all controls are neutral and off.
    """

    lost: bool
    """The receiver hears no transmitter."""
    speed: Annotated[float, Field(ge=-1, le=1)] = 0.0
    """Stick, forward positive."""
    steer: Annotated[float, Field(ge=-1, le=1)] = 0.0
    """Stick, left positive."""
    arm: bool = False
    """Switch without which the robot does not move."""
    drive: bool = True
    """The hand drives; False: it only supervises."""
    estop: bool = False
    """Switch of the emergency stop."""
    unseen: bool = False
    """Switch to drive into unseen ground."""
    link_quality: Annotated[float, Field(ge=0, le=1)] | None = None
    """Fraction of the radio's packets that arrive; None if unknown."""
    rssi: float | None = None
    """Signal at the receiver (dBm); None if unknown."""

    @property
    def switches(self) -> tuple[bool, ...]:
        """Link and switches."""
        return self.lost, self.arm, self.drive, self.estop, self.unseen


class CompressedImage(Message):
    """One camera image; ``stamp`` is its time of exposure, as far as the camera reports it."""

    model_config: ClassVar[ConfigDict] = ConfigDict(ser_json_bytes="base64", val_json_bytes="base64")

    data: bytes
    """The whole file, for ``jpeg`` from its FF D8 to its FF D9."""
    format: Literal["jpeg"] = "jpeg"
    sequence: Annotated[int, Field(ge=0, lt=2**32)]
    """The camera's own count of pictures; a gap is a picture that was lost before the daemon had it."""


class TorqueState(StrEnum):
    """Whether a joint of the stabiliser can hold the lidar."""

    HOLDING = "holding"
    LIMP = "limp"
    """The unit answers, but gives no torque: after an alarm, or until it is set up."""
    ABSENT = "absent"
    """The unit does not answer."""


class StabiliserJoint(Schema):
    """One servo of the lidar's mount; signs follow the joint angle. Measurements of an absent servo are None."""

    torque: TorqueState
    """State of the unit's torque."""
    error: Annotated[int, Field(ge=0, le=255)] = 0
    """Error bits of the unit's latest answer (in its own encoding)."""
    velocity: float | None = None
    """Rad/s."""
    load: float | None = None
    """Torque the unit gives, share of its greatest (-1..1): an estimate from its control error, not a measurement."""
    voltage: float | None = None
    """Supply at the unit, V."""
    temperature: float | None = None
    """Degree Celsius."""
    strays: Annotated[int, Field(ge=0)] = 0
    """Times that the unit drove itself away from its goal and lost its torque, since the driver's start."""


class StabiliserFeedback(Message):
    """Joints of the lidar's mount, reported by its servos.

    The pitch joint is mounted on the body, the roll joint on the pitch joint, and the lidar on the roll joint: the
    lidar's axes are Ry(pitch) Rx(roll) in ``frame``, that is roll, pitch, yaw = (roll, pitch, 0) of REP 103.
    """

    pitch: float | None = None
    """Joint angle about y, rad, REP 103: nose DOWN positive; None: unknown."""
    roll: float | None = None
    """Joint angle about x of the pitched part, rad, REP 103: right side down positive; None: unknown."""
    pitch_joint: StabiliserJoint
    roll_joint: StabiliserJoint


class StandPose(Message):
    """Pose of a robot measured by an external test stand; ``frame`` is the stand's, with its origin in the middle.

    For studies and for evaluating estimates: estimators and planners do not read it. The consistency check compares it
    with the robot's own measures of its motion.
    """

    pose: Pose2D
    observer: Literal["simulator", "overhead"]
    """Who saw it: the simulated world, or cameras over the table."""
    position_sigma: Annotated[float, Field(ge=0)]
    """Standard deviation of x and of y, m."""
    heading_sigma: Annotated[float, Field(ge=0)]
    """Rad."""
