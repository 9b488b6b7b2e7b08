"""Dead reckoning: motor turns along the steered arc, with the heading corrected by the compass.

Between two drive readings the pose is a prediction, and its covariance grows with the reading's age.
"""

import math
import operator
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from struct import Struct
from typing import Annotated, Any, Final, Literal, NamedTuple, Protocol

import numpy as np
from pydantic import Field

from monstertruck_estimation.gyro import GyroConfig
from monstertruck_estimation.heading_turns import HeadingTurns
from monstertruck_estimation.inertial import Inertial, InertialInput
from monstertruck_estimation.transforms import Quaternion, wrap_angle
from monstertruck_estimation.wheel_motion import WheelIncrement, WheelMotion
from monstertruck_kinematics.chassis import Chassis
from monstertruck_kinematics.elementary import Array
from monstertruck_kinematics.se2 import Pose2, Twist2, integrate, integration_jacobians
from monstertruck_runtime.clock import SECOND, Clock, Lead, Schedule
from monstertruck_runtime.mailbox import fifo, latest
from monstertruck_runtime.ports import BusPort, EventSink, Publisher, Ready, Subscription
from monstertruck_schemas import topics
from monstertruck_schemas.base import NotNegative, Pose2D, Positive, Schema, Twist2D
from monstertruck_schemas.event import Severity
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.roles import ServiceName
from monstertruck_schemas.sensor import Attitude, DriveFeedback, SteeringFeedback
from monstertruck_schemas.state import Odometry

SOURCE_TIMEOUT: Final = SECOND
"""Time for which a sensor remains listed as a source after a reading (ns)."""


_NINE: Final = Struct("9d")


class PlanarCovariance(NamedTuple):
    """Upper triangle of the covariance of (x, y, yaw) (m^2, m rad, rad^2); plain floats are faster than numpy here."""

    xx: float = 0.0
    xy: float = 0.0
    yy: float = 0.0
    xw: float = 0.0
    yw: float = 0.0
    ww: float = 0.0

    def moved(self, dx: float, dy: float) -> "PlanarCovariance":
        """Return the covariance after a motion (dx, dy) in the frame of the pose (m), rotated by the uncertain yaw."""
        xx, xy, yy, xw, yw, ww = self
        ahead, aside = xw - dy * ww, yw + dx * ww
        return PlanarCovariance(
            xx - dy * (xw + ahead), xy + dx * xw - dy * aside, yy + dx * (yw + aside), ahead, aside, ww
        )

    def plus(self, other: Iterable[float]) -> "PlanarCovariance":
        """Return the sum with an independent covariance."""
        return PlanarCovariance(*map(operator.add, self, other))

    def corrected(self, gain_x: float, gain_y: float, gain: float) -> "PlanarCovariance":
        """Return the covariance after a yaw update with these gains."""
        xx, xy, yy, xw, yw, ww = self
        return PlanarCovariance(
            xx - gain_x * xw, xy - gain_x * yw, yy - gain_y * yw, xw - gain_x * ww, yw - gain_y * ww, ww - gain * ww
        )

    def matrix(self) -> Array:
        """Return all nine numbers, row-major and read-only."""
        xx, xy, yy, xw, yw, ww = self
        return np.frombuffer(_NINE.pack(xx, xy, xw, xy, yy, yw, xw, yw, ww))


class CompassConfig(Schema):
    """Correction of the heading by the compass."""

    noise: Positive = 0.05
    """Standard deviation of a heading (rad); larger than the sensor's own: its errors are correlated in time."""
    gate: Positive = 3.0
    """Outlier gate: maximum deviation of an accepted heading, in standard deviations."""
    alignment: Annotated[int, Field(ge=1)] = 10
    """Number of headings averaged at the start to find north in odom, unless the truck drives off earlier."""


class OdometrySettings(Schema):
    """Common settings of all odometry kinds."""

    kind: str
    rate: Annotated[float, Field(gt=0, le=200)] = 50.0
    """Publishing rate of poses (1/s)."""


class OdometryConfig(OdometrySettings):
    """Dead reckoning: initial pose and noise."""

    kind: Literal["reckoning"] = "reckoning"
    start: Pose2D = Pose2D(x=0.0, y=0.0, yaw=0.0)
    """Initial pose of base in odom (m, rad)."""
    distance_noise: NotNegative = 0.02
    """Standard deviation of the distance per root metre driven (m)."""
    lateral_noise: NotNegative = 0.01
    """Standard deviation of sideways slip per root metre driven (m)."""
    yaw_noise: NotNegative = 0.05
    """Standard deviation of the heading per root metre driven (rad)."""
    speed_noise: NotNegative = 0.05
    """Standard deviation of the predicted speed (m/s)."""
    turn_noise: NotNegative = 0.1
    """Standard deviation of the predicted yaw rate (rad/s)."""
    max_prediction: Positive = 0.3
    """Maximum time of prediction without a drive reading (s); then the pose stays, and its covariance grows."""
    max_speed: Positive = 0.6
    """Maximum speed between two drive positions (m/s); beyond it, the drive has restarted with a new origin."""
    compass: CompassConfig | None = CompassConfig()
    """Null uses the wheels' heading alone."""
    gyro: GyroConfig | None = GyroConfig()
    """Yaw rate of an inertial measurement unit, if the robot has one; null leaves it out"""


@dataclass(frozen=True, slots=True)
class OdometryEstimate:
    """Pose of base in odom and twist in base at one instant."""

    pose: Pose2
    """x, y (m), yaw (rad, in [-pi, pi])."""
    twist: Twist2
    """vx, vy (m/s), wz (rad/s)."""
    pose_covariance: Array
    """Shape (9,), row-major."""
    twist_covariance: Array
    """Shape (9,), row-major."""
    age: float
    """Age of the latest drive reading (s)."""
    sources: tuple[str, ...]


class SensorInput(Protocol):
    """Additional sensor of an ``OdometryService``, with an adapter that passes its messages to the estimator."""

    def take(self) -> None:
        """Pass new messages to the estimator, before those of the wheels."""

    def report(self) -> None:
        """Emit events about changes."""


class OdometryEstimator(Protocol):
    """Pose estimator of an ``OdometryService``."""

    def observe_steering(self, feedback: SteeringFeedback) -> None:
        """Add the commanded servo angles."""

    def observe_drive(self, *shafts: DriveFeedback) -> None:
        """Add a reading of every driven shaft."""

    def observe_attitude(self, attitude: Attitude) -> None:
        """Add heading and tilt."""

    def estimate(self, now: int) -> OdometryEstimate | None:
        """Return the pose at ``now`` (ns); None before the first reading."""


class DeadReckoning:
    """Extended Kalman filter of (x, y, yaw), predicted by the drive and corrected in yaw by the compass.

    Args:
        config: initial pose and noise.
        chassis: maps motors and servos to the body's motion.
        inertial: inertial measurement unit whose yaw rate replaces the wheels'; None for the wheels alone.
    """

    def __init__(self, config: OdometryConfig, chassis: Chassis, inertial: Inertial | None = None) -> None:
        self._config = config
        self._chassis = chassis
        self._pose: Pose2 = (config.start.x, config.start.y, config.start.yaw)
        self._covariance = PlanarCovariance()
        self._slip = (config.distance_noise**2, config.lateral_noise**2, config.yaw_noise**2)
        self._drift = PlanarCovariance(xx=config.speed_noise**2, yy=config.speed_noise**2, ww=config.turn_noise**2)
        self._twist_covariance = self._drift.matrix()
        self._wheels = WheelMotion(chassis, config.max_speed)
        self._driven = 0.0
        self._aligning: list[float] = []
        self._north: float | None = None
        self._compass_used: int | None = None
        self._gyro = None if inertial is None else inertial.gyro
        self._gyro_used: int | None = None
        self._turns = HeadingTurns()
        self._otherwise = 0
        """Number of successive headings that contradict ``doubt``: outliers if it is None, otherwise inliers."""
        self.rejected_headings = 0
        """Number of headings rejected by the outlier gate."""
        self.doubt: str | None = None
        """Reason why headings are rejected; None while they are used."""

    def observe_steering(self, feedback: SteeringFeedback) -> None:
        """Add the commanded servo angles, unless the servo controller marks them untrusted."""
        self._wheels.observe_steering(feedback)

    def observe_drive(self, *shafts: DriveFeedback) -> None:
        """Add the position of every motor and move the pose along the arc since the last positions."""
        roll = self._wheels.observe_drive(*shafts)
        if roll is not None:
            self._move(roll)

    @property
    def _reached(self) -> int:
        """Stamp of the pose (ns)."""
        return self._wheels.stamp

    @property
    def _twist(self) -> Twist2:
        """Velocity used to predict the pose."""
        return self._wheels.twist

    @property
    def _carriers(self) -> tuple[str, ...]:
        """Sensors that currently determine the pose."""
        return ("drive",)

    def _move(self, roll: WheelIncrement) -> None:
        """Predict along the wheels' arc."""
        dt = roll.dt
        if roll.lost:
            self._lose(dt)
            return
        self._driven += roll.distance
        vx, vy, wz = roll.twist
        trusted = self._gyro is not None and self._gyro.trusted
        rate = None if self._gyro is None else self._gyro.turned(roll.since, roll.stamp, wz, roll.distance)
        drifted = 0.0
        if rate is not None and self._gyro is not None:
            wz, self._gyro_used = rate, roll.stamp
            drifted = self._gyro.variance(roll.stamp, dt, roll.distance)
        pose = integrate(self._pose, vx, vy, wz, dt)
        moved = self._covariance.moved(pose[0] - self._pose[0], pose[1] - self._pose[1])
        self._covariance = moved.plus(self._slipped(roll))
        if trusted and self._gyro is not None and not self._gyro.trusted:
            drifted = self._gyro.difference**2
        self._covariance = self._covariance.plus(PlanarCovariance(ww=drifted))
        self._pose = pose
        self._turns.moved(wz * dt, roll.distance)

    def observe_attitude(self, attitude: Attitude) -> None:
        """Add a heading: the first ones determine north in odom, later ones correct the yaw."""
        config = self._config.compass
        if config is None or not self._wheels.known:
            return
        if attitude.heading_disturbed:
            self._turns.forget()
            return
        if self._turns.observe(-attitude.heading):
            self._contradict()
        if self._turns.contrary is not None:
            return
        ahead = min(max((attitude.stamp - self._reached) / SECOND, -1.0), self._config.max_prediction)
        yaw = self._pose[2] + self._twist[2] * ahead
        # The device counts clockwise from north.
        off = -attitude.heading - yaw
        if self._north is None:
            self._align(off, config)
            return
        innovation = wrap_angle(off - self._north)
        variance = self._covariance.ww + config.noise**2
        off = innovation**2 > config.gate**2 * variance
        self._otherwise = self._otherwise + 1 if off is (self.doubt is None) else 0
        if self._otherwise >= config.alignment:
            self._otherwise = 0
            self.doubt = f"it deviates by {innovation:+.2f} rad from the wheels" if off else None
        if off:
            self.rejected_headings += 1
            return
        x, y, heading = self._pose
        gain_x, gain_y, gain = (share / variance for share in self._covariance[3:])
        self._pose = (x + gain_x * innovation, y + gain_y * innovation, heading + gain * innovation)
        self._covariance = self._covariance.corrected(gain_x, gain_y, gain)
        self._compass_used = attitude.stamp
        self._turns.corrected(gain * innovation)

    def estimate(self, now: int) -> OdometryEstimate | None:
        """Return the pose predicted to ``now`` (ns); None before the first drive reading."""
        if not self._wheels.known:
            return None
        age = max((now - self._reached) / SECOND, 0.0)
        twist = self._twist
        ahead = min(age, self._config.max_prediction)
        x, y, yaw = integrate(self._pose, *twist, ahead)
        # The uncertain yaw rotates the predicted motion; the speed's variance is added equally in all directions.
        moved = self._covariance.moved(x - self._pose[0], y - self._pose[1])
        covariance = moved.plus(term * age**2 for term in self._drift)
        twist_covariance = self._twist_covariance
        if (waited := age - ahead) > 0.0:
            # The robot may still move: the pose stays, at speed 0, with the covariance of a possible motion.
            pace, turn = twist[0] ** 2 + twist[1] ** 2, twist[2] ** 2
            lost = PlanarCovariance(xx=pace, yy=pace, ww=turn)
            covariance = covariance.plus(term * waited**2 for term in lost)
            twist, twist_covariance = (0.0, 0.0, 0.0), self._drift.plus(lost).matrix()
        sources = [*self._carriers] if now - self._reached <= SOURCE_TIMEOUT else []
        for name, used in (
            ("steering", self._wheels.steered),
            ("compass", self._compass_used),
            ("imu", self._gyro_used),
        ):
            if used is not None and now - used <= SOURCE_TIMEOUT:
                sources.append(name)
        return OdometryEstimate(
            pose=(x, y, wrap_angle(yaw)),
            twist=twist,
            pose_covariance=covariance.matrix(),
            twist_covariance=twist_covariance,
            age=age,
            sources=tuple(sources),
        )

    def _contradict(self) -> None:
        """Undo the corrections by headings that turn against the robot, or no longer do, and determine north again."""
        self._north, self._otherwise, self.doubt = None, 0, None
        self._aligning.clear()
        contrary = self._turns.contrary
        if contrary is None:
            return
        self.doubt, by = contrary.text, contrary.correction
        x, y, yaw = self._pose
        self._pose = (x, y, yaw - by)
        aside = (by * contrary.distance) ** 2
        self._covariance = self._covariance.plus(PlanarCovariance(xx=aside, yy=aside, ww=by**2))

    def _lose(self, dt: float) -> None:
        """Add the uncertainty of an unknown motion after the drive's counter restarted."""
        lost = (self._config.max_speed * dt) ** 2
        turned = lost * self._chassis.bicycle.curvature(0.4, -0.4) ** 2
        self._covariance = self._covariance.plus(PlanarCovariance(xx=lost, yy=lost, ww=turned))

    def _slipped(self, roll: WheelIncrement) -> PlanarCovariance:
        """Return the covariance added by slip along the arc."""
        (a, b, c), (d, e, f), (_, _, g) = integration_jacobians(self._pose, *roll.twist, roll.dt)[1].tolist()
        along, aside, turned = (share * roll.distance / roll.dt**2 for share in self._slip)
        return PlanarCovariance(
            xx=a * a * along + b * b * aside + c * c * turned,
            xy=a * d * along + b * e * aside + c * f * turned,
            yy=d * d * along + e * e * aside + f * f * turned,
            xw=c * g * turned,
            yw=f * g * turned,
            ww=g * g * turned,
        )

    def _align(self, off: float, config: CompassConfig) -> None:
        self._aligning.append(off)
        # 0.02: maximum distance from the start of a truck at standstill, m
        if len(self._aligning) >= config.alignment or self._driven > 0.02:
            self._north = math.atan2(
                sum(math.sin(value) for value in self._aligning), sum(math.cos(value) for value in self._aligning)
            )


def _no_events(*_: Any, **__: Any) -> None:
    """Event sink that discards all events."""


class OdometryService:
    """Publish odometry on an absolute schedule, in odom and, without localisation, unchanged in map.

    Args:
        reckoning: pose estimator.
        clock: the service's clock.
        drives: feedback of every driven shaft.
        steering: servo feedback; None for a body without steering.
        compass: headings; None without a compass.
        odometry: publisher of ``state/odometry``.
        pose: ``state/pose``; None: published by localisation.
        imu: measurements of the inertial measurement unit; None without one.
        encoders: encoders of wheels that are not driven, if the estimator takes them.
        events: sink of reports about rejected headings.
        rate: publishing rate of poses (1/s).
    """

    name = ServiceName.ODOMETRY.value

    def __init__(
        self,
        reckoning: OdometryEstimator,
        clock: Clock,
        *,
        drives: Sequence[Subscription[DriveFeedback]],
        steering: Subscription[SteeringFeedback] | None,
        compass: Subscription[Attitude] | None,
        odometry: Publisher[Odometry],
        pose: Publisher[Odometry] | None,
        imu: InertialInput | None = None,
        encoders: SensorInput | None = None,
        events: EventSink = _no_events,
        rate: float = 50.0,
    ) -> None:
        self._reckoning = reckoning
        self._clock = clock
        self._drives = tuple(drives)
        self._steering = steering
        self._compass = compass
        self._odometry = odometry
        self._pose = pose
        self._also = tuple(also for also in (imu, encoders) if also is not None)
        self._events = events
        self._rate = rate
        self._reckoned: tuple[DriveFeedback, ...] = ()
        self._seen: tuple[object, object] = (None, None)
        self._doubted = False

    async def run(self, ready: Ready) -> None:
        """Publish until cancelled; the first pose follows the first drive reading."""
        ready()
        schedule = Schedule(self._clock, self._rate, Lead.ESTIMATES)
        while True:
            await schedule.next()
            self.take()
            now = self._clock.now()
            estimate = self._reckoning.estimate(now)
            if estimate is not None:
                message = _message(estimate, now, self._odometry.next_seq())
                self._odometry.put(message)
                if self._pose is not None:
                    self._pose.put(message.model_copy(update={"frame": "map", "seq": self._pose.next_seq()}))

    def take(self) -> None:
        """Pass new messages to the estimator, and report changes."""
        for also in self._also:
            also.take()
        steering = None if self._steering is None else self._steering.latest
        compass = None if self._compass is None else self._compass.latest
        before = self._seen
        self._seen = (steering, before[1])
        if steering is not None and steering is not before[0]:
            self._reckoning.observe_steering(steering)
        drives = tuple(reading for drive in self._drives if (reading := drive.latest) is not None)
        known = self._reckoned or (None,) * len(drives)
        if len(drives) == len(self._drives) and all(now is not then for now, then in zip(drives, known, strict=True)):
            self._reckoned = drives
            self._reckoning.observe_drive(*drives)
        if compass is not None and compass is not before[1] and self.accepts_compass():
            self._seen = (steering, compass)
            self._reckoning.observe_attitude(compass)
        for also in self._also:
            also.report()
        if isinstance(self._reckoning, DeadReckoning):
            self.report_compass(self._reckoning.doubt)

    def report_compass(self, doubt: str | None, returned: str = "") -> None:
        """Report whether headings are rejected, and the reason, or used again."""
        if self._doubted is (doubt is not None):
            return
        self._doubted = doubt is not None
        if doubt is None:
            self._events(Reason.HEADING_RETURNED, Severity.INFO, self.name, returned)
        else:
            text = f"{doubt}; the yaw is estimated without it"
            self._events(Reason.HEADING_DISTURBED, Severity.WARNING, self.name, text)

    def accepts_compass(self) -> bool:
        """Return whether headings are used yet: they correct a pose, which exists from the first drive reading."""
        return bool(self._reckoned)


def _message(estimate: OdometryEstimate, now: int, seq: int) -> Odometry:
    x, y, yaw = estimate.pose
    vx, vy, wz = estimate.twist
    return Odometry(
        stamp=now,
        received=now,
        seq=seq,
        frame="odom",
        pose=Pose2D(x=x, y=y, yaw=yaw),
        twist=Twist2D(vx=vx, vy=vy, wz=wz),
        pose_covariance=estimate.pose_covariance,
        twist_covariance=estimate.twist_covariance,
        age=estimate.age,
        sources=estimate.sources,
    )


@dataclass(frozen=True, slots=True)
class OdometryContext:
    """Robot and bus for which an odometry kind is built."""

    chassis: Chassis
    clock: Clock
    bus: BusPort
    compass: bool
    """Whether the robot has a compass."""
    slam: bool
    """Whether SLAM publishes the pose in map and the motion between scans."""
    imu: Quaternion | None = None
    """Rotation from the axes of its IMU to base; None without an IMU."""
    encoders: bool = False
    """Whether the rear wheels have encoders."""

    def inertial(self, config: GyroConfig | None) -> InertialInput | None:
        """Return the IMU; None if the robot has none or the configuration leaves it out."""
        if self.imu is None or config is None:
            return None
        # 32: maximum number of queued IMU measurements
        measured, events = self.bus.subscribe(topics.IMU, fifo(32)), self.bus.event_sink()
        return InertialInput(Inertial(config, self.imu), measured, events, OdometryService.name)

    def inputs(self) -> dict[str, Any]:
        """Return the topics of an ``OdometryService`` by argument name."""
        bus, shafts, steered = self.bus, len(self.chassis.shafts), self.chassis.steered
        return {
            "drives": [bus.subscribe(topic, latest()) for topic in topics.DRIVES[:shafts]],
            "steering": bus.subscribe(topics.STEERING, latest()) if steered else None,
            "compass": bus.subscribe(topics.COMPASS, latest()) if self.compass else None,
            "odometry": bus.publisher(topics.ODOMETRY, topics.Writer.ESTIMATION),
            "pose": None if self.slam else bus.publisher(topics.POSE, topics.Writer.ESTIMATION),
        }


def build_reckoning(config: OdometryConfig, context: OdometryContext) -> OdometryService:
    """Build the service with its topics, for the catalog."""
    imu = context.inertial(config.gyro)
    reckoning = DeadReckoning(config, context.chassis, None if imu is None else imu.inertial)
    events = context.bus.event_sink()
    return OdometryService(reckoning, context.clock, imu=imu, events=events, rate=config.rate, **context.inputs())
