"""Service that compares the robot's sensors with each other and publishes those that must be wrong."""

import asyncio
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

from monstertruck_estimation.consistency.comparison import Measure
from monstertruck_estimation.consistency.config import MAX_SPEED, ConsistencyConfig
from monstertruck_estimation.consistency.exchange import StepInput, StepOutput
from monstertruck_estimation.consistency.monitor import ConsistencyMonitor
from monstertruck_estimation.consistency.repeats import scan_content
from monstertruck_estimation.inertial import Inertial
from monstertruck_estimation.scan_tilt import ScanAngles, plane_slopes
from monstertruck_estimation.slam.worker_io import ScanInput
from monstertruck_estimation.wheel_motion import WheelMotion
from monstertruck_kinematics.chassis import Chassis, TricycleChassis
from monstertruck_runtime.actors.actor import Actor
from monstertruck_runtime.clock import SECOND, Clock, Lead, Schedule
from monstertruck_runtime.errors import WorkerError
from monstertruck_runtime.mailbox import Mailbox
from monstertruck_runtime.ports import EventSink, Publisher, Ready, Subscription
from monstertruck_schemas.body import Mount
from monstertruck_schemas.event import Severity
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.roles import DeviceRole, ServiceName
from monstertruck_schemas.sensor import (
    Attitude,
    Battery,
    CompressedImage,
    DriveFeedback,
    Imu,
    LaserScan,
    StandPose,
    SteeringFeedback,
    WheelEncoders,
)
from monstertruck_schemas.state import Consistency, Doubt, DoubtKind, GateState

TARGET: Final = "monstertruck_estimation.consistency.scan_odometry:warmed"
START_TIMEOUT: Final = 180.0
"""Time that the worker may take to start (real seconds): numba compiles at the first start."""
PERIOD: Final = SECOND
"""Maximum interval between messages on ``state/consistency`` (ns); every change is published, too."""


@dataclass(frozen=True, slots=True)
class ConsistencyInputs:
    """Compared topics; None for a sensor that the robot lacks."""

    drives: Sequence[Subscription[DriveFeedback]]
    steering: Subscription[SteeringFeedback] | None
    gate: Subscription[GateState]
    scan: Mailbox[LaserScan] | None
    compass: Mailbox[Attitude] | None
    imu: Mailbox[Imu] | None
    encoders: Mailbox[WheelEncoders] | None
    battery: Mailbox[Battery] | None
    camera: Mailbox[CompressedImage] | None
    scan_2: Mailbox[LaserScan] | None = None
    """Second lidar: whether it repeats a scan; only scans of the first one measure motion."""
    stand: Mailbox[StandPose] | None = None
    """Overhead cameras; the ground truth of a simulated world is not a measure."""


@dataclass(frozen=True, slots=True)
class ScanSetup:
    """Setup for comparing scans."""

    actor: Actor
    """Actor that runs ``ScanMotionStep``."""
    mount: Mount
    """Mount of the lidar."""
    angles: ScanAngles | None
    """Angles of body and mount at the times of scans; None without a compass."""


class ConsistencyService:
    """Pass the sensors' messages to a ``ConsistencyMonitor``.

    Args:
        config: tolerances.
        chassis: chassis of the robot.
        clock: the service's clock.
        inputs: topics of the sensors.
        scans: scan odometry; None if the robot has no lidar, or it is switched off.
        inertial: axes of the IMU; None if the robot has none.
        out: publisher of ``state/consistency``.
        events: sink of the findings.
    """

    name = ServiceName.CONSISTENCY.value

    def __init__(
        self,
        config: ConsistencyConfig,
        chassis: Chassis,
        clock: Clock,
        *,
        inputs: ConsistencyInputs,
        scans: ScanSetup | None,
        inertial: Inertial | None,
        out: Publisher[Consistency],
        events: EventSink,
        wheels: str = DeviceRole.DRIVE,
    ) -> None:
        self._config, self._chassis, self._clock = config, chassis, clock
        self._inputs, self._scans, self._inertial = inputs, scans, inertial
        self._out, self._events = out, events
        measured = (
            (Measure.WHEELS, wheels, True),
            (Measure.SCANS, DeviceRole.LIDAR, scans is not None),
            (Measure.GYRO, DeviceRole.IMU, inertial is not None),
            (Measure.COMPASS, DeviceRole.COMPASS, inputs.compass is not None),
            (Measure.ENCODERS, DeviceRole.ENCODERS, inputs.encoders is not None),
            (Measure.STAND, Measure.STAND.value, inputs.stand is not None),
        )
        self.monitor = ConsistencyMonitor(config, {measure: role for measure, role, there in measured if there})
        self._wheels = WheelMotion(chassis, MAX_SPEED)
        self._taken: tuple[object, ...] = ()
        self._steered: object = None
        self._rolled: tuple[int, float, float] | None = None
        """Stamp (ns) and positions (m) of the free wheels."""
        self._active = False
        self._anew = False
        """Whether the scan odometry must forget its past."""
        self._tilted = False
        """Whether the plane of the latest scan was tilted."""
        self._front: str | None = None
        self._published: tuple[object, ...] = ()
        self._published_at = 0
        self._doubts: tuple[Doubt, ...] = ()

    async def run(self, ready: Ready) -> None:
        """Compare until cancelled.

        Raises:
            WorkerError: the worker of the scan odometry failed, hung or died.
        """
        self._front = None
        try:
            async with asyncio.TaskGroup() as group:
                if self._scans is not None and self._inputs.scan is not None:
                    group.create_task(self._follow_scans(self._scans, self._inputs.scan), name="scan odometry")
                ready()
                rate = 25.0  # readings of the sensors per second
                schedule = Schedule(self._clock, rate, Lead.ESTIMATES)
                while True:
                    await schedule.next()
                    self.take()
        except* WorkerError as failed:
            raise failed.exceptions[0] from None

    def take(self) -> None:
        """Forward new messages and publish the result."""
        self._take_gate()
        self._take_wheels()
        self._take_others()
        self._publish()

    def _take_gate(self) -> None:
        state = self._inputs.gate.latest
        active = state is not None and state.mode.active
        if active is not self._active:
            self._active = self._anew = active
            self.monitor.activate(self._clock.now() if active else None)

    def _take_wheels(self) -> None:
        inputs = self._inputs
        steering = None if inputs.steering is None else inputs.steering.latest
        if steering is not None and steering is not self._steered:
            self._steered = steering
            self._wheels.observe_steering(steering)
        drives = tuple(reading for drive in inputs.drives if (reading := drive.latest) is not None)
        known = self._taken or (None,) * len(drives)
        if not drives or len(drives) != len(inputs.drives) or any(a is b for a, b in zip(drives, known, strict=True)):
            return
        self._taken = drives
        roll = self._wheels.observe_drive(*drives)
        if roll is not None:
            self.monitor.observe_wheels(roll)

    def _take_others(self) -> None:
        inputs, monitor = self._inputs, self.monitor
        for attitude in () if inputs.compass is None else inputs.compass.drain():
            yaw = None if attitude.heading_disturbed else -attitude.heading
            monitor.observe_heading(attitude.stamp, yaw)
            for field in ("heading", "roll", "pitch"):
                monitor.observe_value(DeviceRole.COMPASS, field, attitude.stamp, getattr(attitude, field))
        for imu in () if inputs.imu is None else inputs.imu.drain():
            if self._inertial is not None:
                monitor.observe_rate(imu.stamp, self._inertial.turn_rate(imu))
            for field in ("angular_velocity", "linear_acceleration"):
                monitor.observe_value(DeviceRole.IMU, field.replace("_", " "), imu.stamp, getattr(imu, field).z)
        for reading in () if inputs.encoders is None else inputs.encoders.drain():
            self._roll(reading)
        for seen in () if inputs.stand is None else inputs.stand.drain():
            if seen.observer == "overhead":
                monitor.observe_stand(seen.stamp, seen.pose)
        for battery in () if inputs.battery is None else inputs.battery.drain():
            monitor.observe_value(DeviceRole.BATTERY, "voltage", battery.stamp, battery.raw_voltage)
        for scan in () if inputs.scan_2 is None else inputs.scan_2.drain():
            monitor.observe_whole(DeviceRole.LIDAR_2, scan.stamp, scan_content(scan))
        for image in () if inputs.camera is None else inputs.camera.drain():
            monitor.observe_whole(DeviceRole.CAMERA, image.stamp, image.data)

    def _roll(self, reading: WheelEncoders) -> None:
        """Take the motion of a tricycle by its free rear wheels."""
        if not isinstance(self._chassis, TricycleChassis):
            return
        radius = self._chassis.drivetrain.wheel_radius
        before, now = self._rolled, (reading.stamp, reading.left * radius, reading.right * radius)
        self._rolled = now
        if before is None or now[0] <= before[0] or not all(map(math.isfinite, now)):
            return
        dt = (now[0] - before[0]) / SECOND
        vx, vy, wz = self._chassis.twist_of_rear((now[1] - before[1]) / dt, (now[2] - before[2]) / dt)
        self.monitor.observe_encoders(reading.stamp, (vx * dt, vy * dt, wz * dt))

    # Scans

    async def _follow_scans(self, setup: ScanSetup, scans: Mailbox[LaserScan]) -> None:
        async with setup.actor as actor:
            await actor.start()
            async for scan in scans:
                self.monitor.observe_whole(DeviceRole.LIDAR, scan.stamp, scan_content(scan))
                work = self._work(setup, scan)
                if work is None:
                    self.monitor.observe_scan(StepOutput(scan.stamp, None))
                    continue
                output: StepOutput = await actor.step(work)
                self._front = output.front
                self.monitor.observe_scan(output)
                self._publish()

    def _work(self, setup: ScanSetup, scan: LaserScan) -> StepInput | None:
        """Return the worker's task for a scan; None if its plane is tilted.

        A single tilted scan ends the measured motion, but not the evidence of standing: the jolt of a contact looks
        like a tilt.
        """
        angles = None if setup.angles is None else setup.angles.at(scan)
        max_tilt = 0.1  # maximum tilt of the plane of a used scan, rad; beyond it a scan shows the ground
        before, self._tilted = self._tilted, scan.tilt is not None and scan.tilt > max_tilt
        if self._tilted:
            self._anew |= before
            return None
        slopes = None if angles is None else plane_slopes(*angles, yaw=setup.mount.yaw)
        height = setup.mount.z if setup.mount.z > 0 else None
        inputs = replace(ScanInput.of(scan, setup.mount.planar), slopes=slopes, height=height)
        anew, self._anew = self._anew, False
        front = self._config.scans or "own"
        monitor = self.monitor
        if anew:
            return StepInput(inputs, front, anew=True)
        end = scan.stamp + round(len(scan.ranges) * scan.time_increment * SECOND)
        claim, rest = monitor.claim(scan.stamp), monitor.rest_claim(scan.stamp, end)
        rolled = monitor.rolled(scan.stamp)
        slip, delay, drift = self._config.slip, self._config.delay, self._config.drift
        return StepInput(
            inputs, front, claim=claim, lag=monitor.lag(), rest=rest, rolled=rolled, slip=slip, delay=delay, drift=drift
        )

    # Publishing

    def _publish(self) -> None:
        now, doubts = self._clock.now(), self.monitor.findings()
        known = {doubt.sensor for doubt in self._doubts}
        for doubt in doubts:
            if doubt.sensor not in known:
                reason = Reason.SENSOR_FROZEN if doubt.kind is DoubtKind.REPEATS else Reason.SENSORS_DISAGREE
                values = {"sensor": doubt.sensor, "against": doubt.against, "difference": round(doubt.difference, 3)}
                self._events(reason, Severity.WARNING, self.name, f"{doubt.sensor}: {doubt.text}", **values)
        if self._doubts and not doubts:
            self._events(Reason.SENSORS_AGREE, Severity.INFO, self.name, ", ".join(sorted(known)))
        self._doubts = doubts
        used, unshown, standing = self.monitor.in_use(now), self.monitor.unshown, self.monitor.standing
        measures = tuple(measure.value for measure in used)
        distances = tuple(measure.value for measure in used if self.monitor.measures_way(measure))
        visible = (measures, tuple((doubt.sensor, doubt.since) for doubt in doubts), self._front, unshown, standing)
        if visible == self._published and now - self._published_at < PERIOD:
            return
        self._published, self._published_at = visible, now
        self._out.put(
            Consistency(
                stamp=now,
                received=now,
                seq=self._out.next_seq(),
                measures=measures,
                distances=distances,
                doubts=doubts,
                scans=self._front,
                unshown=unshown,
                standing=standing,
            )
        )
