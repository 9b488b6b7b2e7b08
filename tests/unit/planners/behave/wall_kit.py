"""A robot that does what it is asked for, beams that measure the walls of a polygon exactly, and echoes of lines."""

import math
from dataclasses import dataclass, field

import numpy as np

from monstertruck_planners.behave.api import Behaviour, BehaviourStep, Inputs, RequestedMotion
from monstertruck_planners.behave.wall.echoes import ECHO
from monstertruck_runtime.clock import SECOND
from monstertruck_schemas.base import Pose2D, Twist2D
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.sensor import Imu, SonarEcho, SonarRanges, Vector3
from monstertruck_schemas.state import Odometry, Transform, Transforms
from monstertruck_schemas.topics import IMU, ODOMETRY, SONAR, TRANSFORMS

PLACES = {
    "l": (0.0, 0.05, math.pi / 2),
    "fl": (0.05, 0.05, math.pi / 4),
    "f": (0.1, 0.0, 0.0),
    "fr": (0.05, -0.05, -math.pi / 4),
    "r": (0.0, -0.05, -math.pi / 2),
}
AHEAD = (0.05, 0.05, math.pi / 2), (0.1, 0.05, math.pi / 4), (0.12, 0.0, 0.0), (0.1, -0.05, -math.pi / 4)
"""Sonars of ``heard``: side, diagonal, front and far one."""
FURTHEST = 3.0
PERIOD = 0.1


def sonars(ranges, *, dead=(), now=0):
    echoes = [
        SonarEcho(name=name, answered=name not in dead, range=None if name in dead else value, stamp=now)
        for name, value in ranges.items()
    ]
    return SonarRanges(
        stamp=now, received=now, seq=0, sonars=tuple(echoes), field_of_view=0.01, range_min=0.03, range_max=FURTHEST
    )


def odometry(x=0.0, y=0.0, yaw=0.0, vx=0.0, wz=0.0, now=0):
    return Odometry(
        stamp=now,
        received=now,
        seq=0,
        frame="odom",
        pose=Pose2D(x=x, y=y, yaw=yaw),
        twist=Twist2D(vx=vx, vy=0.0, wz=wz),
        pose_covariance=np.zeros(9),
        twist_covariance=np.zeros(9),
        age=0.0,
    )


def imu(wz=0.0, now=0):
    still, gravity = Vector3(x=0.0, y=0.0, z=wz), Vector3(x=0.0, y=0.0, z=9.81)
    return Imu(stamp=now, received=now, seq=0, frame="imu", angular_velocity=still, linear_acceleration=gravity)


def frames(ahead=0.0, left_out=()):
    mounts = [
        Transform(
            parent="base",
            child=f"sonar_{name}",
            stamp=0,
            translation=(x + ahead, y, 0.0),
            rotation=(0.0, 0.0, math.sin(yaw / 2), math.cos(yaw / 2)),
        )
        for name, (x, y, yaw) in PLACES.items()
        if name not in left_out
    ]
    return Transforms(stamp=0, received=0, seq=0, frame="odom", transforms=tuple(mounts))


def rectangle(length, width):
    corners = np.array([(0, 0), (length, 0), (length, width), (0, width)], dtype=float) - (length / 2, width / 2)
    return [(*corners[i], *corners[(i + 1) % 4]) for i in range(4)]


def beam(walls, x, y, angle):
    dx, dy, best = math.cos(angle), math.sin(angle), math.inf
    for x0, y0, x1, y1 in walls:
        ex, ey, px, py = x1 - x0, y1 - y0, x0 - x, y0 - y
        cross = dx * ey - dy * ex
        if cross == 0.0:
            continue
        along, part = (px * ey - py * ex) / cross, (px * dy - py * dx) / cross
        if along >= 0.0 and 0.0 <= part <= 1.0:
            best = min(best, along)
    return best if best <= FURTHEST else None


@dataclass
class Robot:
    """Two wheels, five beams."""

    walls: list
    pose: tuple[float, float, float]
    motion: RequestedMotion = field(default_factory=RequestedMotion)
    stalled: bool = False
    dead: tuple[str, ...] = ()
    stuck: dict[str, float] = field(default_factory=dict)
    dropped: int = 0
    """Every so many-th message has no echo at all; 0 = none."""
    ahead: float = 0.0
    """Of the side sonars before the axle, m."""
    bias: float = 0.0
    """Of the gyroscope, rad/s."""
    creep: float = 0.0
    """Error of the odometry along x, m more in every step."""
    late: int = 0
    """Steps after which it does what it is asked for."""
    count: int = 0
    asked: list[RequestedMotion] = field(default_factory=list)

    def ask(self, motion):
        self.asked.append(motion)
        self.motion = self.asked[max(len(self.asked) - 1 - self.late, 0)]

    def inputs(self):
        x, y, yaw = self.pose
        self.count += 1
        c, s = math.cos(yaw), math.sin(yaw)
        ranges = {
            name: beam(self.walls, x + c * (px + self.ahead) - s * py, y + s * (px + self.ahead) + c * py, yaw + angle)
            for name, (px, py, angle) in PLACES.items()
        }
        if self.dropped and self.count % self.dropped == 0:
            ranges = dict.fromkeys(ranges)
        ranges |= self.stuck
        vx, wz = (0.0, 0.0) if self.stalled else self.motion[:2]
        now = self.count * round(PERIOD * SECOND)
        return Inputs(
            {
                SONAR.name: sonars(ranges, dead=self.dead, now=now),
                ODOMETRY.name: odometry(x + self.creep * self.count, y, yaw, vx, wz, now),
                IMU.name: imu(wz + self.bias, now),
                TRANSFORMS.name: frames(self.ahead),
            }
        )

    def move(self):
        if self.stalled:
            return
        for _ in range(10):
            x, y, yaw = self.pose
            dt = PERIOD / 10
            self.pose = (
                x + self.motion.vx * math.cos(yaw) * dt,
                y + self.motion.vx * math.sin(yaw) * dt,
                yaw + self.motion.wz * dt,
            )

    @property
    def clearance(self):
        """From the reference point to the nearest wall, m."""
        x, y, _ = self.pose
        return min(math.dist((x, y), _nearest(wall, x, y)) for wall in self.walls)


def _nearest(wall, x, y):
    x0, y0, x1, y1 = wall
    ex, ey = x1 - x0, y1 - y0
    part = min(max(((x - x0) * ex + (y - y0) * ey) / (ex * ex + ey * ey), 0.0), 1.0)
    return x0 + part * ex, y0 + part * ey


@dataclass
class Drive:
    steps: list[BehaviourStep]
    poses: np.ndarray
    clearance: float
    """The least on the way, m."""

    @property
    def outcome(self) -> Reason:
        return self.steps[-1].outcome

    def motions(self):
        return np.array([step.motion[:2] for step in self.steps if step.motion is not None])


def drive(behaviour: Behaviour, robot: Robot, seconds: float) -> Drive:
    """Until the behaviour ends."""
    state, steps, poses, clearance = behaviour.begin(), [], [], math.inf
    for i in range(round(seconds / PERIOD)):
        step = behaviour.step(robot.inputs(), state, i * PERIOD)
        state = step.state
        steps.append(step)
        poses.append(robot.pose)
        clearance = min(clearance, robot.clearance)
        if step.outcome is not Reason.DRIVING:
            break
        robot.ask(step.motion or RequestedMotion())
        robot.move()
    return Drive(steps, np.array(poses), clearance)


def heard(line, poses, cone, noise=0.0, seed=0):
    """Echoes of a line by side, diagonal, front and far sonar of a robot at poses."""
    rng, rows = np.random.default_rng(seed), []
    for i, (x, y, yaw) in enumerate(poses):
        for number, (ex, ey, axis) in enumerate(AHEAD):
            c, s = math.cos(yaw), math.sin(yaw)
            px, py, direction = x + c * ex - s * ey, y + s * ex + c * ey, yaw + axis
            if not cone.hears(direction, line.normal):
                continue
            beyond = max(abs(math.remainder(line.normal - direction, math.tau)) - cone.half, 0.0)
            distance = line.distance(px, py) / math.cos(beyond) + rng.normal(0, noise)
            rows.append((px, py, direction, distance, number, 0.0, i * 0.1))
    return np.array(rows).reshape(-1, len(ECHO))


def turning(lines, cone, yaws):
    """Echoes of the first of some lines that each sonar hears, of a robot that turns on the spot at the origin."""
    poses, first = [(0.0, 0.0, yaw) for yaw in yaws], {}
    for line in lines:
        for row in heard(line, poses, cone):
            first.setdefault((row[6], row[4]), row)
    return np.array([first[key] for key in sorted(first)])
