"""A robot in the plane that docks: a body with lag, odometry that drifts, and images of a tag with noise."""

import math
from collections import deque
from dataclasses import dataclass, field

import numpy as np

from monstertruck_kinematics.chassis import Dimensions, truck_chassis
from monstertruck_kinematics.se2 import between, compose, integrate
from monstertruck_kinematics.truck import DriveTrain
from monstertruck_planners.behave.api import BehaviourBody, BehaviourStep, Inputs
from monstertruck_planners.behave.dock.config import DockConfig, DockingConfig, UndockConfig
from monstertruck_planners.behave.dock.docking import Dock, Undock
from monstertruck_planners.behave.dock.estimate import facing
from monstertruck_schemas.base import Pose2D, Twist2D
from monstertruck_schemas.points import TagPose, TagPoses
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.sensor import Battery, BatteryLevel
from monstertruck_schemas.state import Odometry
from monstertruck_schemas.topics import BATTERY, ODOMETRY, POSE, TAGS

SECOND = 1_000_000_000
DT = 0.05
CAMERA = 0.18
"""Of the camera ahead of base, m."""


@dataclass
class Robot:
    """Docks at ``dock``, whose docked pose it knows only by the tag."""

    dock: DockConfig
    pose: np.ndarray
    seed: int = 0
    hidden: bool = False
    charger: float = 3.0
    """Current of the charger (A)."""
    sensor: bool = True
    """Whether it measures the current."""
    located: bool = True
    """Whether its pose in the map is known."""
    trail: list[np.ndarray] = field(default_factory=list)
    phases: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.rng = np.random.default_rng(self.seed)
        self.body = BehaviourBody(truck_chassis(Dimensions(DriveTrain())), 0.436)
        self.odom = np.array((5.0, -3.0, 1.0))
        """Odometry begins anywhere."""
        self.delayed = deque([(0.0, 0.0)] * 4, 4)
        """Commands of the latest 0.2 s."""
        self.now = SECOND
        self.tags = TagPoses(stamp=0, received=0, seq=0, frame="base")
        self.bias = self.rng.normal(0, (0.01, 0.005))

    @property
    def target(self) -> np.ndarray:
        return np.array((self.dock.x, self.dock.y, self.dock.yaw))

    @property
    def error(self) -> tuple[float, float]:
        """Distance (m) and heading (rad) from the docked pose."""
        off = between(self.target, self.pose)
        return math.hypot(off[0], off[1]), abs(float(off[2]))

    def move(self, vx: float, wz: float) -> None:
        self.delayed.append((vx, wz))
        vx, wz = self.delayed[0]
        self.pose = np.array(integrate(tuple(self.pose), vx, 0.0, wz, DT))
        scale, drift = self.bias
        measured = np.array(integrate((0.0, 0.0, 0.0), vx * (1 + scale), 0.0, wz * (1 + scale) + drift * vx, DT))
        self.odom = compose(self.odom, measured)
        self.now += round(DT * SECOND)
        self.trail.append(self.pose.copy())

    def look(self, every: int) -> None:
        """Take an image; it arrives two steps later, which is left out: the pose then is in its stamp."""
        if self.hidden or len(self.trail) % every:
            return
        tag = compose(facing(self.target, self.dock), np.array((self.dock.tag_distance, self.dock.tag_offset, math.pi)))
        local = between(self.pose, tag)
        away = float(local[0]) - CAMERA
        tags = ()
        if away > 0.25 and abs(local[1]) < 0.55 * away:
            spread = np.diag((1e-3 * away, 1e-3 * away, 0.006 * (away / 0.42) ** 2))
            x, y, yaw = self.rng.multivariate_normal(local, spread**2)
            tags = (TagPose(tag=self.dock.tag, x=x, y=y, z=0.25, yaw=yaw, covariance=(spread**2).ravel()),)
        self.tags = TagPoses(stamp=self.now, received=self.now, seq=1, frame="base", tags=tags)

    def inputs(self) -> Inputs:
        header = {"stamp": self.now, "received": self.now, "seq": 1}

        def place(pose, frame):
            x, y, yaw = map(float, pose)
            return Odometry(
                **header, frame=frame, pose=Pose2D(x=x, y=y, yaw=math.remainder(yaw, math.tau)),
                twist=Twist2D(vx=0.0, vy=0.0, wz=0.0), pose_covariance=np.zeros(9), twist_covariance=np.zeros(9),
                age=0.0, sources=(),
            )  # fmt: skip

        off, turn = self.error
        charges = off < 0.01 and turn < 0.0175
        known = self.pose + self.rng.normal(0, (0.003, 0.003, 0.002))
        return Inputs({
            ODOMETRY.name: place(self.odom, "odom"),
            **({POSE.name: place(known, "map")} if self.located else {}),
            TAGS.name: self.tags,
            BATTERY.name: Battery(
                **header, raw_voltage=23.0, cells=6, level=BatteryLevel.NORMAL,
                rest_voltage=23.0 + 0.1 * self.charger * charges,
                current=(self.charger * charges - 1.0) if self.sensor else None,
            ),
        })  # fmt: skip

    def run(self, behaviour: Dock | Undock, limit: float = 200.0) -> BehaviourStep:
        state, t = behaviour.begin(), 0.0
        while t < limit:
            self.look(every=2)
            step = behaviour.step(self.inputs(), state, t)
            state, t = step.state, t + DT
            if not self.phases or self.phases[-1] != step.phase:
                self.phases.append(step.phase)
            if step.outcome is not Reason.DRIVING:
                return step
            motion = step.motion
            self.move(*((0.0, 0.0) if motion is None else (motion.vx, motion.wz)))
        raise AssertionError(f"no end after {limit} s: {self.phases}")

    def docks(self, **settings) -> BehaviourStep:
        config = DockingConfig(docks={"charger": self.dock}, **settings)
        return self.run(Dock.fit(config, self.body))

    def undocks(self) -> BehaviourStep:
        return self.run(Undock.fit(UndockConfig(docks={"charger": self.dock}), self.body))
