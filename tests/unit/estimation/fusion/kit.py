"""A truck that drives, its sensors with honest noise and delays, and a fusion fed by them."""

import math

import numpy as np

from monstertruck_estimation.fusion.config import FusionConfig
from monstertruck_estimation.fusion.estimator import Fusion
from monstertruck_estimation.inertial import Inertial
from monstertruck_estimation.transforms import IDENTITY
from monstertruck_kinematics.se2 import between, compose
from monstertruck_runtime.clock import SECOND
from monstertruck_schemas.base import Pose2D
from monstertruck_schemas.sensor import Attitude, Imu, Vector3
from monstertruck_schemas.state import ScanMotion
from tests.unit.estimation.kit import CHASSIS, DRIVETRAIN, STEERING, drive_feedback, servo_feedback

TICK = SECOND // 100
ALL = ("wheels", "compass", "scans")
FIELD = 46.0


def config(**sections):
    return FusionConfig(kind="fusion", **sections)


def attitude(now, yaw, **more):
    return Attitude(stamp=now, received=now, seq=0, heading=(-yaw) % math.tau, **{"roll": 0.0, "pitch": 0.0, **more})


def imu(now, rate=(0.0, 0.0, 0.0), force=(0.0, 0.0, 9.81)):
    rate, force = (dict(zip("xyz", vector, strict=True)) for vector in (rate, force))
    return Imu(stamp=now, received=now, seq=0, angular_velocity=Vector3(**rate), linear_acceleration=Vector3(**force))


def scan_motion(since, stamp, delta, covariance):
    x, y, yaw = (float(value) for value in delta)
    return ScanMotion(
        stamp=stamp,
        received=stamp,
        seq=0,
        since=since,
        motion=Pose2D(x=x, y=y, yaw=yaw),
        covariance=np.asarray(covariance, dtype=np.float64).ravel(),
    )


class Rig:
    """Truth and IMU at 100 Hz, wheels and compass at 20 Hz, scans at 10 Hz that are matched 50 ms later.

    Args:
        sensors: those that are there.
        seed: of all noise.
        settings: sections of the fusion's configuration.
    """

    scan_noise = (0.004, 0.004, 0.003)
    wheel_noise = 0.02
    delay = 5

    def __init__(self, sensors=ALL, seed=1, **settings):
        own = config(**settings)
        self.inertial = Inertial(own.imu, IDENTITY) if "imu" in sensors else None
        self.fusion = Fusion(own, CHASSIS, self.inertial)
        self.gyro = 1.0
        """Share of the yaw rate that the IMU shows."""
        self.turned = 0.0
        self.sensors, self.rng = set(sensors), np.random.default_rng(seed)
        self.now, self.pose, self.motor = SECOND, (0.0, 0.0, 0.0), 0.0
        self.slip, self.magnet, self.field, self.north, self.degenerate = 1.0, 0.0, FIELD, 0.7, None
        self.seen = 1.0
        """Share of the way that scans show."""
        self.crooked, self.count, self.last, self.waiting = 0.0, 0, None, []
        self.estimates, self.truths, self.changes = [], [], []
        self._observe(0.0, 0.0)

    def drive(self, speed, front, rear, seconds):
        for _ in range(round(seconds * 100)):
            before = self.pose
            self.pose = STEERING.integrate(self.pose, *STEERING.body_twist(speed, front, rear), 0.01)
            self.turned = math.remainder(self.pose[2] - before[2], math.tau) / 0.01
            way = STEERING.drive_speed(speed, front, rear) * 0.01
            noise = self.wheel_noise * math.sqrt(math.hypot(self.pose[0] - before[0], self.pose[1] - before[1]))
            self.motor += DRIVETRAIN.motor_angle(way * self.slip + self.rng.normal(0.0, noise))
            self.now += TICK
            self.count += 1
            self._observe(front, rear)
        return self

    def _observe(self, front, rear):
        if "imu" in self.sensors:
            rate = self.turned * self.gyro + 0.01 + self.rng.normal(0.0, 0.003)
            self.inertial.observe(imu(self.now, (0.0, 0.0, rate)))
        if self.count % 5 == 0 and "wheels" in self.sensors:
            self.fusion.observe_steering(servo_feedback(self.now, front + self.crooked, rear - self.crooked))
            self.fusion.observe_drive(drive_feedback(self.now, self.motor))
        if self.count % 5 == 2 and "compass" in self.sensors:
            yaw = self.pose[2] - self.north + self.magnet + self.rng.normal(0.0, 0.009)
            field = Vector3(x=self.field, y=0.0, z=0.0)
            self.fusion.observe_attitude(attitude(self.now, yaw, magnetic_field=field))
        if self.count % 10 == 0 and "scans" in self.sensors:
            self._scan()
        while self.waiting and self.waiting[0].stamp + self.delay * TICK <= self.now:
            self.fusion.observe_scan(self.waiting.pop(0))
        self.changes += self.fusion.changes()
        if self.count % 2 == 0 and (estimate := self.fusion.estimate(self.now)) is not None:
            self.estimates.append(estimate)
            self.truths.append(self.pose)

    def _scan(self):
        noise = np.diag(np.square(self.scan_noise))
        place = compose(np.array(self.pose), self.rng.normal(0.0, self.scan_noise))
        if self.last is not None:
            since, then = self.last
            delta = between(np.array(then), np.array(place)) * self.seen
            if self.degenerate is not None:
                # Along the direction (in odom) anything may come out.
                along = self.degenerate - self.pose[2]
                axis = np.array((math.cos(along), math.sin(along), 0.0))
                delta = delta + axis * self.rng.normal(0.0, 0.5)
                noise = noise + np.outer(axis, axis) * 100.0
            self.waiting.append(scan_motion(since, self.now, delta, noise))
        self.last = (self.now, place)

    def settle(self):
        """Estimates until nothing waits to be redone."""
        while self.fusion.waiting:
            self.fusion.estimate(self.now)

    @property
    def estimate(self):
        return self.estimates[-1]

    def error(self):
        """Position, m, and yaw, rad."""
        x, y, yaw = self.estimate.pose
        return math.hypot(x - self.pose[0], y - self.pose[1]), abs(math.remainder(yaw - self.pose[2], math.tau))

    def nees(self):
        """Normalised error squared of the pose of every published estimate."""
        values = []
        for estimate, truth in zip(self.estimates, self.truths, strict=True):
            off = np.array(estimate.pose) - truth
            off[2] = math.remainder(off[2], math.tau)
            values.append(float(off @ np.linalg.solve(estimate.pose_covariance.reshape(3, 3) + 1e-9 * np.eye(3), off)))
        return np.array(values)

    def steps(self):
        """Way between neighbouring published poses, m."""
        places = np.array([estimate.pose[:2] for estimate in self.estimates])
        return np.hypot(*np.diff(places, axis=0).T)


def wander(rig, seconds=30.0):
    """Straight, left, right, crab, backwards."""
    share = seconds / 6
    for speed, front, rear in (
        (0.3, 0.0, 0.0),
        (0.3, 0.2, -0.2),
        (0.25, -0.25, 0.1),
        (0.15, 0.2, 0.2),
        (-0.2, 0.1, -0.1),
        (0.3, -0.1, 0.1),
    ):
        rig.drive(speed, front, rear, share)
    return rig
