"""Paths, and a truck that obeys with the rates of the real one."""

import math
from types import SimpleNamespace

import numpy as np
from pydantic import TypeAdapter

from monstertruck_kinematics.truck import FourWheelSteering
from monstertruck_planners.track.catalog import AnyTracker, build_tracker
from monstertruck_planners.track.path_tracker import EXACT, TruckState
from monstertruck_planners.track.segments import SegmentedPath
from monstertruck_runtime.clock import SECOND
from monstertruck_schemas.plan import Path
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.sensor import VALID_BEAM, LaserScan

STEERING = FourWheelSteering()
TRACKER = TypeAdapter(AnyTracker)


def path(points, directions=(), *, closed=False, frame="odom", yaws=0.0, steering=()):
    points = np.asarray(points, dtype=float)
    poses = np.column_stack((points, np.broadcast_to(yaws, len(points))))
    return Path(
        stamp=0,
        received=0,
        seq=0,
        frame=frame,
        poses=poses.ravel(),
        directions=list(directions),
        closed=closed,
        steering=tuple(steering),
        name="test",
    )


def straight(length=2.0, step=0.05):
    x = np.arange(0.0, length + step / 2, step)
    return np.column_stack((x, np.zeros_like(x)))


def circle(radius=1.0, turns=1.0, step=0.05):
    angle = np.linspace(0, math.tau * turns, round(math.tau * turns * radius / step), endpoint=False)
    return np.column_stack((radius * np.sin(angle), radius * (1 - np.cos(angle))))


def figure_eight(size=1.5, count=240):
    t = np.linspace(0, math.tau, count, endpoint=False)
    return np.column_stack((size * np.sin(t), size * np.sin(t) * np.cos(t)))


class Follower:
    """A truck driven by a tracker at 20 Hz, whose axles turn and slip by ``errors``."""

    def __init__(self, route, pose=(0.0, 0.0, 0.0), *, errors=EXACT, **config):
        self.errors = errors
        self.config = TRACKER.validate_python({"kind": "pure_pursuit"} | config)
        self.tracker = build_tracker(self.config, STEERING)
        self.pose = pose
        self.speed, self.front, self.rear = 0.0, 0.0, 0.0
        self.path = SegmentedPath(route, pose, self.config.beyond)
        self.t = 0.0
        self.progress = self.path.start
        self.log = []
        self.clearance = math.inf

    def step(self):
        twist = self.twist()
        command = self.tracker.control(
            TruckState(self.pose, twist[0], self.clearance), self.path, self.progress, self.t
        )
        self.t += 0.05
        self.progress = command.progress
        self.log.append(command)
        for _ in range(5):
            self.front += float(np.clip(command.front - self.front, -0.01, 0.01))
            self.rear += float(np.clip(command.rear - self.rear, -0.01, 0.01))
            self.speed += float(np.clip(command.speed - self.speed, -0.01, 0.01))
            self.pose = STEERING.integrate(self.pose, *self.twist(), 0.01)
        return command

    def twist(self):
        wheels = self.errors.wheels((self.front, self.rear), self.speed**2 / STEERING.wheelbase)
        return STEERING.body_twist(self.speed, *wheels)

    def run(self, seconds=200.0):
        """Until the path ends; the outcome."""
        for _ in range(round(seconds * 20)):
            if self.step().outcome is not Reason.DRIVING:
                break
        return self.log[-1].outcome

    def cross_track(self, after=0.0):
        """Absolute cross-track errors once ``after`` metres are driven."""
        return np.abs([c.cross_track for c in self.log if self.path.along(c.progress) >= after])

    def along(self):
        return np.array([self.path.along(c.progress) for c in self.log])


def scanned_on_the_move(wall, lidar=(0.14, 0.0, 0.0), late=0.2):
    """A truck that turns on its way to a wall at x = ``wall``: a scan that began ``late`` s ago, odometry of now."""
    twist, now, each = STEERING.body_twist(0.2, 0.33, -0.33), 10 * SECOND, 0.1 / 1024
    pose, bearings, ranges = (0.0, 0.0, 0.3), np.linspace(-0.3, 0.6, 200), []
    for i, bearing in enumerate(bearings.tolist()):
        x, y, yaw = STEERING.integrate(pose, *twist, i * each - late)
        x, y = x + math.cos(yaw) * lidar[0] - math.sin(yaw) * lidar[1], y + math.sin(yaw) * lidar[0]
        ranges.append((wall - x) / math.cos(yaw + lidar[2] + bearing))
    scan = LaserScan(
        stamp=now - round(late * SECOND), received=now - SECOND // 20, seq=0, start_angle=-0.3, end_angle=0.6,
        time_increment=each, scan_time=0.1, range_min=0.06, range_max=4.1, ranges=np.array(ranges),
        codes=np.full(len(ranges), VALID_BEAM, np.uint8),
    )  # fmt: skip
    odometry = SimpleNamespace(
        stamp=now,
        pose=SimpleNamespace(**dict(zip(("x", "y", "yaw"), pose, strict=True))),
        twist=SimpleNamespace(**dict(zip(("vx", "vy", "wz"), twist, strict=True))),
    )
    return scan, odometry, lidar
