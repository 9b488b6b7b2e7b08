"""A robot with five sonars, odometry and a gyroscope, driven along walls by a behaviour: no daemon, no gate.

It follows the requested twist within the acceleration of its gate and a lag of 50 ms. Sonars measure ten times a
second, the behaviour runs at its own rate. After the behaviour's end, and when a topic it reads is stale, it brakes.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from time import thread_time
from typing import Any, Final, Literal, NamedTuple

import numpy as np

from benchmarks.wall_parts.arena import Arena, blocked, rays
from monstertruck_kinematics.elementary import Array
from monstertruck_kinematics.profiles import TimedRamp
from monstertruck_planners.behave.api import Behaviour, Inputs, RequestedMotion
from monstertruck_runtime.clock import SECOND
from monstertruck_schemas.base import Pose2D, Twist2D
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.sensor import Imu, SonarEcho, SonarRanges, Vector3
from monstertruck_schemas.state import Odometry, Transform, Transforms
from monstertruck_schemas.topics import IMU, ODOMETRY, SONAR, TRANSFORMS
from monstertruck_sim.world.config import FIVE_SONARS, SonarModelConfig
from tests.sonar_kit import survey

FINE: Final = 0.01
SONAR_PERIOD: Final = 10
"""In fine steps."""
LAG: Final = 0.05
"""Time constant of the drives, s."""
HALF_TRACK: Final = 0.135
ACCELERATION, YAW_ACCELERATION, YAW_RATE, BRAKING = 0.8, 6.0, 1.5, 1.0
"""Limits of the robot's gate: m/s^2, rad/s^2, rad/s, m/s^2."""
JUMP: Final = 0.8
"""Change of a speed asked for beyond which it jumps, m/s^2 and rad/s^2: the published ramps have 0.6 at most."""
IMU_STALE: Final = IMU.fresh_for()
LIMIT: Final = 600.0
"""Seconds a run may take."""
HEAD: Final[dict[str, Any]] = {"stamp": 0, "received": 0, "seq": 0}
COVARIANCE: Final = np.zeros(9)
GRAVITY: Final = Vector3(x=0.0, y=0.0, z=9.81)

FaultKind = Literal["dead", "stuck", "cross-talk", "imu", "motor"]


@dataclass(frozen=True)
class Fault:
    """A fault and its time, s."""

    kind: FaultKind
    at: float
    part: str
    """Name of a sonar; ``left`` or ``right`` for a motor."""


class WallRun(NamedTuple):
    """One run."""

    reason: Reason
    text: str
    contact: bool
    seconds: float
    asked: Array
    """(n, 2) speed and yaw rate asked for, step by step."""
    period: float
    track: Array
    """(m, 5): x, y, yaw of the middle with the wall on the left (m, rad), time (s), whether it has found a wall."""
    wheels: float
    """Greatest speed of a wheel, m/s."""
    ramps: list[TimedRamp]
    """That were planned."""
    costs: Array
    """Processor time of every step of the behaviour, without the simulation, s."""

    def jumps(self) -> tuple[int, int, float, float]:
        """Return how often requested speed and yaw rate jump from one step to the next, and their largest changes."""
        changes = np.abs(np.diff(self.asked, axis=0)) if len(self.asked) > 1 else np.zeros((1, 2))
        counts = (changes > JUMP * self.period + 1e-9).sum(axis=0)
        return int(counts[0]), int(counts[1]), float(changes[:, 0].max()), float(changes[:, 1].max())


@dataclass
class Body:
    """True pose, motion, and estimated pose of the robot."""

    pose: tuple[float, float, float]
    scale: float
    drift: float
    v: float = 0.0
    w: float = 0.0
    believed: tuple[float, float, float] = (0.0, 0.0, 0.0)
    stalled: str = ""

    def move(self, v: float, w: float, braking: float = ACCELERATION) -> None:
        """Execute a fine step towards a twist."""
        w = min(max(w, -YAW_RATE), YAW_RATE)
        self.v += float(np.clip((v - self.v) * FINE / LAG, -braking * FINE, braking * FINE))
        self.w += float(np.clip((w - self.w) * FINE / LAG, -YAW_ACCELERATION * FINE, YAW_ACCELERATION * FINE))
        v, w = self.driven
        x, y, yaw = self.pose
        self.pose = x + v * math.cos(yaw) * FINE, y + v * math.sin(yaw) * FINE, yaw + w * FINE
        x, y, yaw = self.believed
        yaw += w * FINE + self.drift * v * FINE
        self.believed = x + self.scale * v * math.cos(yaw) * FINE, y + self.scale * v * math.sin(yaw) * FINE, yaw

    @property
    def driven(self) -> tuple[float, float]:
        """Return speed and yaw rate with a stalled wheel."""
        left, right = self.v - self.w * HALF_TRACK, self.v + self.w * HALF_TRACK
        left, right = (0.0 if self.stalled == "left" else left), (0.0 if self.stalled == "right" else right)
        return (left + right) / 2, (right - left) / (2 * HALF_TRACK)

    @property
    def wheel(self) -> float:
        """Return the speed of the faster wheel, m/s."""
        return abs(self.v) + abs(self.w) * HALF_TRACK


class Ears:
    """Messages of the sonars.

    Args:
        cast: ray caster of the walls.
        model: model of the sonars.
        rng: random numbers of their noise.
        fault: fault of one of them.
    """

    def __init__(self, cast: Any, model: SonarModelConfig, rng: np.random.Generator, fault: Fault | None) -> None:
        self._cast, self._model, self._rng, self._fault = cast, model, rng, fault
        self._last: dict[str, float] = {}

    def hear(self, pose: tuple[float, float, float], t: float, now: int) -> SonarRanges:
        """Return one round of measurements."""
        heard, dead, fault = dict(survey(self._cast, pose, self._model, self._rng)), "", self._fault
        if fault is not None and t >= fault.at:
            if fault.kind == "dead":
                dead = fault.part
            elif fault.kind == "stuck":
                heard[fault.part] = self._last[fault.part]
            elif fault.kind == "cross-talk" and self._rng.random() < 0.5:
                heard[fault.part] = min(heard[fault.part], float(self._rng.uniform(0.15, 3.0)))
        self._last = heard
        echoes = tuple(
            SonarEcho(
                name=n, answered=n != dead, range=r if math.isfinite(r) and n != dead else None, stamp=now
            )
            for n, r in heard.items()
        )  # fmt: skip
        model = self._model
        return SonarRanges(
            stamp=now, received=now, seq=0, sonars=echoes, field_of_view=model.field_of_view,
            range_min=model.range_min, range_max=model.range_max,
        )  # fmt: skip


def mounts() -> Transforms:
    """Return the mounts of the five sonars."""
    return Transforms(
        **HEAD,
        frame="odom",
        transforms=tuple(
            Transform(
                parent="base", child=f"sonar_{name}", stamp=0, translation=(p.x, p.y, 0.0),
                rotation=(0.0, 0.0, math.sin(p.yaw / 2), math.cos(p.yaw / 2)),
            )
            for name, p in FIVE_SONARS.items()
        ),
    )  # fmt: skip


def mirrored(walls: Array) -> Array:
    """Return the mirrored walls, for a wall on the right."""
    return walls * np.array([1.0, -1.0, 1.0, -1.0])


def drive_along(
    pilot: Behaviour,
    rate: float,
    arena: Arena,
    side: str,
    seed: int,
    *,
    model: str = "cone",
    start: tuple[float, float, float] | None = None,
    fault: Fault | None = None,
    watch: Callable[[float, Body, Any], None] | None = None,
) -> WallRun:
    """Drive until the behaviour ends, the robot touches a wall, or the time is over.

    Args:
        pilot: the behaviour.
        rate: its steps per second.
        arena: walls of a clockwise lap.
        side: side of the wall.
        seed: seed of start, noise, and odometry errors.
        model: model of the sonars.
        start: start pose; None: near the centre, with a random heading.
        fault: fault during the run.
        watch: called every step.
    """
    rng = np.random.default_rng(seed)
    walls = arena.walls if side == "left" else mirrored(arena.walls)
    sonar = SonarModelConfig(model=model, dropout=0.05, sonars=FIVE_SONARS)  # type: ignore[arg-type]
    drawn = float(rng.uniform(-0.5, 0.5)), float(rng.uniform(-0.5, 0.5)), float(rng.uniform(-math.pi, math.pi))
    body = Body(start or drawn, 1 + float(rng.normal(0, 0.003)), float(rng.normal(0, 0.0003)))
    body.believed = body.pose
    bias = float(rng.uniform(-0.01, 0.01))
    ears = Ears(partial(rays, walls), sonar, rng, fault)
    state, frames = pilot.begin(), mounts()
    asked: list[tuple[float, float]] = []
    track: list[tuple[float, ...]] = []
    ramps: list[TimedRamp] = []
    costs: list[float] = []
    motion, end, ended, contact = RequestedMotion(), Reason.TIMEOUT, None, False
    text, steps, wheels, heard, phase = "", round(1 / (rate * FINE)), 0.0, None, ""
    mirror = 1.0 if side == "left" else -1.0
    for i in range(round(LIMIT / FINE)):
        t, now = i * FINE, round(i * FINE * SECOND)
        if i % SONAR_PERIOD == 0:
            heard = ears.hear(body.pose, t, now)
            x, y, yaw = body.pose
            track.append((x, y * mirror, yaw * mirror, t, float(phase not in ("", "settle", "search", "approach"))))
        body.stalled = fault.part if fault is not None and fault.kind == "motor" and t >= fault.at else ""
        if i % steps == 0 and ended is None:
            assert heard is not None
            if fault is not None and fault.kind == "imu" and t >= fault.at + IMU_STALE and IMU in pilot.reads:
                end, text, ended = Reason.INPUT_STALE, "sensor/imu", t
            else:
                inputs, begun = _inputs(heard, body, bias, frames, now, rng), thread_time()
                step = pilot.step(inputs, state, t)
                costs.append(thread_time() - begun)
                state, phase = step.state, step.phase
                if watch is not None:
                    watch(t, body, step)
                ramps += [
                    r for r in (getattr(state, "v", None), getattr(state, "w", None)) if r and r not in ramps[-2:]
                ]
                motion = step.motion or RequestedMotion()
                if step.outcome is Reason.DRIVING:
                    asked.append(motion[:2])
                else:
                    end, text, ended, motion = step.outcome, step.text, t, RequestedMotion()
        if ended is not None:
            motion = RequestedMotion()
        body.move(motion.vx, motion.wz, ACCELERATION if ended is None else BRAKING)
        wheels = max(wheels, body.wheel)
        if i % 2 == 0 and blocked(walls, *body.pose):
            contact, end = True, Reason.OBSTACLE_STOP
            break
        if ended is not None and t - ended > 1.0:
            break
    return WallRun(
        end, text, contact, ended if ended is not None else t, np.array(asked), 1 / rate,
        np.array(track).reshape(-1, 5), wheels, ramps, np.array(costs),
    )  # fmt: skip


def _inputs(
    heard: SonarRanges, body: Body, bias: float, frames: Transforms, now: int, rng: np.random.Generator
) -> Inputs:
    v, w = body.driven
    x, y, yaw = body.believed
    head: dict[str, Any] = {"stamp": now, "received": now, "seq": 0}
    odometry = Odometry(
        **head, frame="odom", pose=Pose2D(x=x, y=y, yaw=yaw), twist=Twist2D(vx=v, vy=0.0, wz=w),
        pose_covariance=COVARIANCE, twist_covariance=COVARIANCE, age=0.0,
    )  # fmt: skip
    rate = w + bias + float(rng.normal(0.0, 0.003))
    imu = Imu(**head, frame="imu", angular_velocity=Vector3(x=0.0, y=0.0, z=rate), linear_acceleration=GRAVITY)
    return Inputs({SONAR.name: heard, ODOMETRY.name: odometry, IMU.name: imu, TRANSFORMS.name: frames})
