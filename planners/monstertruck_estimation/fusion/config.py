"""Settings of the fusion; light, for the daemon's start."""

from typing import Annotated, Final, Literal

from pydantic import Field

from monstertruck_estimation.gyro import GyroConfig
from monstertruck_estimation.odometry import OdometrySettings
from monstertruck_schemas.base import NotNegative, Pose2D, Positive, Schema

DEVIATION_SCALE: Final = (2.0, 1.0)
"""Distance, m, and turn, rad, after which the local deviation of the compass is another: iron is in floors and
furniture."""


class WheelTrust(Schema):
    """What the wheels are worth."""

    shaft_noise: Positive = 0.02
    """Standard deviation of every shaft's distance per root metre it rolled, m."""
    angle_noise: NotNegative = 0.01
    """Standard deviation of the mean angle of a steered axle over a metre, rad."""
    slip_noise: tuple[NotNegative, NotNegative, NotNegative] = (0.01, 0.01, 0.03)
    """Standard deviations of slip of the wheels, forward and sideways (m) and in yaw (rad), per root metre."""
    trim: Positive = 0.05
    """Standard deviation of the constant error of the curvature at the start (a servo off its centre), rad/m."""
    trim_drift: Positive = 0.002
    """How fast that may change, rad/m per root second."""


class HeadingTrust(Schema):
    """What the compass is worth, and when it is left out."""

    noise: Positive = 0.02
    """Standard deviation of a heading, rad."""
    local: Positive = 0.05
    """Standard deviation of what iron near by and the truck's own adds to it, rad; it lasts two metres or a radian."""
    drift: Positive = 0.001
    """How fast its north may wander, rad per root second."""
    gate: Positive = 3.0
    """A heading further off than this many standard deviations is left out."""
    field: Positive = 0.05
    """Share by which the strength of the magnetic field may differ from what it was at the start."""
    recover: Annotated[int, Field(ge=1)] = 10
    """Good headings in a row after which a compass that was disturbed is used again."""
    regain: Positive = 2.0
    """Motion over which these headings must be good, m or rad; alternatively the steady time."""
    steady_time: Positive = 10.0
    """Seconds after which a heading that is steadily off, its field undisturbed, is taken for a new north."""


class ScanTrust(Schema):
    """What the motion between scans is worth."""

    scale: Positive = 1.0
    """Factor on the standard deviation the matching claims."""
    drift: tuple[NotNegative, NotNegative] = (0.0005, 0.0005)
    """Standard deviation by which the map, against which scans are matched, drifts from one to the next, m and rad."""


class ImuTrust(GyroConfig):
    """What the yaw rate of an inertial measurement unit is worth, and when it is left out."""

    noise: Positive = 0.005
    """Standard deviation of its turn, its bias included, rad per root second."""
    scale: NotNegative = 0.01
    """Standard deviation of its scale."""


class SlipConfig(Schema):
    """Detection of wheel slip."""

    window: Positive = 0.4
    """Seconds over which wheels and scans are compared."""
    gate: Positive = 4.5
    """The wheels slip when they differ from the scans by more than this many standard deviations twice in a row"""
    release: Positive = 2.5
    """Slip ends when they differ by less than this many standard deviations ``calm`` times in a row"""
    calm: Annotated[int, Field(ge=1)] = 5
    """Comparisons in a row that end slip"""
    timing: Positive = 0.01
    """Standard deviation of the offset between the stamps of both, s."""
    speed: Positive = 0.5
    """Standard deviation of the speed of wheels that slip, m/s."""
    turn: Positive = 1.0
    """Standard deviation of the yaw rate of wheels that slip, rad/s."""


class FusionConfig(OdometrySettings):
    """Odometry from wheels, compass, IMU and scans, whichever there are."""

    kind: Literal["fusion"]
    start: Pose2D = Pose2D(x=0.0, y=0.0, yaw=0.0)
    """Pose of base in odom at the start, m and rad."""
    max_speed: Positive = 0.6
    """A drive position that would need more than this, m/s, is a new origin (the drive restarted), not a motion."""
    max_turn: Positive = 3.0
    """Scans that would need a greater yaw rate than this, rad/s, or a greater speed, are mismatched"""
    max_prediction: Positive = 0.3
    """Seconds the last motion is carried on without a reading; then the pose waits, its covariance grows on."""
    agility: tuple[Positive, Positive, Positive] = (0.7, 0.3, 1.5)
    """How fast the velocity may change, forward and sideways (m/s) and in yaw (rad/s), per root second."""
    persistence: Positive = 2.0
    """Time constant with which an unobserved velocity dies away, s."""
    horizon: Positive = 5.0
    """Measurements may come this late, s, and headings of so long before a disturbance was noticed are taken back."""
    slew: tuple[Positive, Positive] = (0.5, 1.0)
    """Rate at which the published pose follows corrections at most, m/s and rad/s: it never jumps."""
    settle: Positive = 0.4
    """Time constant with which the published pose follows corrections, s."""
    wheels: WheelTrust | None = WheelTrust()
    """Null leaves the wheels out"""
    compass: HeadingTrust | None = HeadingTrust()
    """Null leaves the compass out"""
    imu: ImuTrust | None = ImuTrust()
    """Null leaves the IMU out; it is used between readings of the wheels"""
    scans: ScanTrust | None = ScanTrust()
    """Null leaves the scans out; they are used where `slam` matches them"""
    slip: SlipConfig = SlipConfig()
