"""Settings of the fusion; light, for the daemon's start."""

from typing import Annotated, Final, Literal

from pydantic import Field

from monstertruck_estimation.gyro import GyroConfig
from monstertruck_estimation.odometry import OdometrySettings
from monstertruck_schemas.base import NotNegative, Pose2D, Positive, Schema

DEVIATION_SCALE: Final = (2.0, 1.0)
"""Distance (m) and turn (rad) after which the compass's local deviation has changed: iron is in floors and
furniture."""


class WheelTrust(Schema):
    """Noise model of the wheels."""

    shaft_noise: Positive = 0.02
    """Standard deviation of every shaft's distance per root metre rolled (m)."""
    angle_noise: NotNegative = 0.01
    """Standard deviation of the mean angle of a steered axle over a metre (rad)."""
    slip_noise: tuple[NotNegative, NotNegative, NotNegative] = (0.01, 0.01, 0.03)
    """Standard deviations of slip of the wheels, forward and sideways (m) and in yaw (rad), per root metre."""
    trim: Positive = 0.05
    """Standard deviation of the constant error of the curvature at the start, from a servo off its centre (rad/m)."""
    trim_drift: Positive = 0.002
    """Maximum rate of change of that error (rad/m per root second)."""


class HeadingTrust(Schema):
    """Noise model of the compass, and the limits beyond which its headings are rejected."""

    noise: Positive = 0.02
    """Standard deviation of a heading (rad)."""
    local: Positive = 0.05
    """Standard deviation added by iron nearby and in the truck (rad); it lasts two metres or a radian."""
    drift: Positive = 0.001
    """Maximum drift of its north (rad per root second)."""
    gate: Positive = 3.0
    """Maximum deviation of a heading that is used, in standard deviations."""
    field: Positive = 0.05
    """Maximum change of the magnetic field's strength since the start, as a share."""
    recover: Annotated[int, Field(ge=1)] = 10
    """Number of good headings in a row before a disturbed compass is used again."""
    regain: Positive = 2.0
    """Motion over which these headings must be good (m or rad); alternatively the steady time."""
    steady_time: Positive = 10.0
    """Time before a heading that is steadily off, its field undisturbed, becomes a new north (s)."""


class ScanTrust(Schema):
    """Noise model of the motion between scans."""

    scale: Positive = 1.0
    """Factor on the standard deviation that the scan matcher states."""
    drift: tuple[NotNegative, NotNegative] = (0.0005, 0.0005)
    """Standard deviation of the drift, per scan, of the map against which scans are matched (m, rad)."""


class ImuTrust(GyroConfig):
    """Noise model of an inertial measurement unit's yaw rate."""

    noise: Positive = 0.005
    """Standard deviation of its turn, including its bias (rad per root second)."""
    scale: NotNegative = 0.01
    """Standard deviation of its scale."""


class SlipConfig(Schema):
    """Detection of wheel slip."""

    window: Positive = 0.4
    """Time over which wheels and scans are compared (s)."""
    gate: Positive = 4.5
    """The wheels slip when they differ from the scans by more than this many standard deviations twice in a row"""
    release: Positive = 2.5
    """Slip ends when they differ by less than this many standard deviations ``calm`` times in a row"""
    calm: Annotated[int, Field(ge=1)] = 5
    """Number of comparisons in a row that end slip"""
    timing: Positive = 0.01
    """Standard deviation of the offset between the stamps of both (s)."""
    speed: Positive = 0.5
    """Standard deviation of the speed of slipping wheels (m/s)."""
    turn: Positive = 1.0
    """Standard deviation of the yaw rate of slipping wheels (rad/s)."""


class FusionConfig(OdometrySettings):
    """Odometry from wheels, compass, IMU and scans, as far as available."""

    kind: Literal["fusion"]
    start: Pose2D = Pose2D(x=0.0, y=0.0, yaw=0.0)
    """Pose of base in odom at the start (m, rad)."""
    max_speed: Positive = 0.6
    """A drive position that would need a higher speed (m/s) is a new origin (the drive restarted), not a motion."""
    max_turn: Positive = 3.0
    """Scans that would need a higher yaw rate than this (rad/s), or a higher speed, are mismatched"""
    max_prediction: Positive = 0.3
    """Maximum time of prediction without a reading (s); then the pose waits, and its covariance grows."""
    agility: tuple[Positive, Positive, Positive] = (0.7, 0.3, 1.5)
    """Change of the velocity, forward and sideways (m/s) and in yaw (rad/s), per root second."""
    persistence: Positive = 2.0
    """Time constant for the decay of an unobserved velocity (s)."""
    horizon: Positive = 5.0
    """Maximum latency of a measurement (s); headings of this time before a disturbance was noticed are taken back."""
    slew: tuple[Positive, Positive] = (0.5, 1.0)
    """Maximum rate of the published pose when it follows corrections (m/s, rad/s): it never jumps."""
    settle: Positive = 0.4
    """Time constant of the published pose when it follows corrections (s)."""
    wheels: WheelTrust | None = WheelTrust()
    """Null leaves the wheels out"""
    compass: HeadingTrust | None = HeadingTrust()
    """Null leaves the compass out"""
    imu: ImuTrust | None = ImuTrust()
    """Null leaves the IMU out; it is used between readings of the wheels"""
    scans: ScanTrust | None = ScanTrust()
    """Null leaves the scans out; they are used where `slam` matches them"""
    slip: SlipConfig = SlipConfig()
