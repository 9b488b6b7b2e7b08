"""Keeps the lidar level: the body's tilt becomes goals of the mount's two joints.

**Convention.** All angles are REP 103: pitch about y, nose down positive; roll about x, right side down positive.
The compass gives the body's tilt in a level frame as R = Ry(pitch) Rx(roll), heading left out. The mount's pitch
joint sits on the body, its roll joint on the pitch joint, the lidar on the roll joint: M = Ry(a) Rx(b). The lidar is
level when the third row of R M is (0, 0, 1): its own up axis, M z, is then the body's view of up,
u = R^T z = (-sin p, sin r cos p, cos r cos p). With M z = (sin a cos b, -sin b, cos a cos b) that gives

    b = -asin(sin r cos p),   a = -atan2(sin p, cos r cos p).

For tilt about one axis the joint is the opposite angle. For both, a heading of second order remains (4 degrees at
15 and 15): who uses the scan takes it from the joint angles.

**Prediction.** A compass reading is old when it comes, and a joint is late on its goal. Held against a body that
rocks by 15 degrees at 0.5 Hz, each 10 ms of that cost up to half a degree. So the tilt is followed by a filter of
constant acceleration (the fading-memory polynomial filter of second degree, also called critically damped g-h-k; see
Brookner, "Tracking and Kalman Filtering Made Easy") and predicted to the instant when the joints will be there.

**Driving.** The compass finds the vertical by an accelerometer, which feels the body's own acceleration too: 0.9 m/s^2
look like 5 degrees, and the prediction would make 10 of them. The odometry's acceleration, by its speed and its speed
times its yaw rate, is taken out of each reading, averaged over ``felt`` seconds as the accelerometer's filter does.
"""

import math
from collections import deque
from dataclasses import dataclass
from typing import Annotated, Final, Literal, NamedTuple

from pydantic import Field

from monstertruck_runtime.clock import SECOND, Clock, Schedule
from monstertruck_runtime.mailbox import Mailbox, fifo, latest
from monstertruck_runtime.ports import BusPort, Publisher, Ready, Subscription
from monstertruck_schemas.base import Schema
from monstertruck_schemas.plan import StabiliserCommand
from monstertruck_schemas.sensor import Attitude
from monstertruck_schemas.state import Odometry
from monstertruck_schemas.topics import COMPASS, ODOMETRY, PLAN_STABILISER, Writer

GRAVITY: Final = 9.81
KEPT: Final = 64
"""Readings of the odometry."""
GREATEST: Final = 2.0
"""Acceleration of the body that is taken out at most, m/s^2: wheels that spin know no better."""

Positive = Annotated[float, Field(gt=0)]
Limit = Annotated[float, Field(gt=0, lt=math.pi / 2)]


class StabiliserConfig(Schema):
    """How the lidar is kept level."""

    kind: Literal["stabiliser"] = "stabiliser"
    rate: Annotated[float, Field(gt=0, le=100)] = 25.0
    """Goals a second."""
    pitch_limit: Limit = math.radians(30)
    """Greatest joint angle to either side, rad."""
    roll_limit: Limit = math.radians(30)
    max_rate: Positive = 3.0
    """Greatest change of a goal, rad/s."""
    lead: Annotated[float, Field(ge=0, le=0.5)] = 0.036
    """Seconds by which a joint is late on its goal: servo, bus and half a period of the goals."""
    memory: Annotated[float, Field(gt=0, lt=1)] = 0.4
    """Share of the past that one reading leaves in the filter; more is calmer and later."""
    coast: Positive = 0.2
    """Seconds over which tilt may be predicted beyond its newest reading."""
    felt: Annotated[float, Field(gt=0, le=0.5)] = 0.06
    """Seconds over which the odometry's acceleration is averaged, as the compass's accelerometer feels it."""
    stale_after: Positive = COMPASS.fresh_for()
    """Seconds without valid tilt after which the joints return to 0."""


class Tilt(NamedTuple):
    """Of the body, rad, REP 103."""

    roll: float
    pitch: float


class Joints(NamedTuple):
    """Of the mount, rad, REP 103."""

    pitch: float
    roll: float


SQUARE = Joints(0.0, 0.0)
"""Lidar parallel to the body."""


def level(tilt: Tilt) -> Joints:
    """Joint angles that level the lidar, see the module."""
    p, r = tilt.pitch, tilt.roll
    return Joints(pitch=-math.atan2(math.sin(p), math.cos(r) * math.cos(p)), roll=-math.asin(math.sin(r) * math.cos(p)))


def goals(tilt: Tilt | None, before: Joints, dt: float, config: StabiliserConfig) -> Joints:
    """Next goals: towards a level lidar, or to 0 without a tilt.

    Args:
        tilt: of the body when the joints will have followed; None = unknown.
        before: goals ``dt`` seconds earlier.
        dt: s.
        config: limits.
    """
    wanted = SQUARE if tilt is None else level(tilt)
    step = config.max_rate * dt
    return Joints(
        pitch=_towards(before.pitch, _clip(wanted.pitch, config.pitch_limit), step),
        roll=_towards(before.roll, _clip(wanted.roll, config.roll_limit), step),
    )


def _clip(value: float, limit: float) -> float:
    return min(max(value, -limit), limit)


def _towards(before: float, wanted: float, step: float) -> float:
    return before + _clip(wanted - before, step)


@dataclass(slots=True)
class _Axis:
    """Angle, rate and acceleration of one axis: rad, rad/s, rad/s^2."""

    angle: float
    rate: float = 0.0
    acceleration: float = 0.0

    def ahead(self, dt: float) -> float:
        return self.angle + dt * (self.rate + dt * self.acceleration / 2)

    def correct(self, measured: float, dt: float, memory: float) -> None:
        off = measured - self.ahead(dt)
        forget = 1 - memory
        self.angle = measured - memory**3 * off
        self.rate += dt * self.acceleration + 1.5 * forget**2 * (1 + memory) * off / dt
        self.acceleration += forget**3 * off / dt**2


class BodyAcceleration:
    """The body's acceleration by its odometry.

    Args:
        felt: seconds over which it is averaged.
    """

    def __init__(self, felt: float) -> None:
        self._felt = round(felt * SECOND)
        self._speeds: deque[tuple[int, float, float]] = deque(maxlen=KEPT)

    def observe(self, odometry: Odometry) -> None:
        """Take a reading; older ones than the newest are passed over."""
        if not self._speeds or odometry.stamp > self._speeds[-1][0]:
            self._speeds.append((odometry.stamp, odometry.twist.vx, odometry.twist.wz))

    def at(self, stamp: int) -> tuple[float, float]:
        """Forward and left, m/s^2, over the time before ``stamp``, ns; 0 where the odometry does not tell."""
        spell = [speed for speed in self._speeds if stamp - 2 * self._felt <= speed[0] <= stamp]
        old = next((speed for speed in reversed(spell) if speed[0] <= stamp - self._felt), None)
        if old is None or old is spell[-1]:
            return 0.0, 0.0
        new = spell[-1]
        forward = (new[1] - old[1]) * SECOND / (new[0] - old[0])
        left = (new[1] * new[2] + old[1] * old[2]) / 2
        return _clip(forward, GREATEST), _clip(left, GREATEST)


def without(acceleration: tuple[float, float], tilt: Tilt) -> Tilt:
    """Tilt of a body whose accelerometer took the reaction to gravity and to its acceleration for the vertical.

    Args:
        acceleration: forward and left, m/s^2.
        tilt: measured.
    """
    forward, left = acceleration
    return Tilt(tilt.roll - math.atan2(left, GRAVITY), tilt.pitch + math.atan2(forward, GRAVITY))


class TiltFilter:
    """Follows valid tilt and predicts it.

    Args:
        config: memory and times.
    """

    def __init__(self, config: StabiliserConfig) -> None:
        self._config = config
        self._stamp: int | None = None
        self._roll = self._pitch = _Axis(0.0)

    def observe(self, attitude: Attitude, acceleration: tuple[float, float] = (0.0, 0.0)) -> None:
        """Take a reading; invalid and older ones are passed over, after a gap it starts anew.

        Args:
            attitude: reading.
            acceleration: of the body then, forward and left, m/s^2.
        """
        if not attitude.tilt_valid or (self._stamp is not None and attitude.stamp <= self._stamp):
            return
        dt = math.inf if self._stamp is None else (attitude.stamp - self._stamp) / SECOND
        self._stamp = attitude.stamp
        roll, pitch = without(acceleration, Tilt(attitude.roll, attitude.pitch))
        if dt > self._config.stale_after:
            self._roll, self._pitch = _Axis(roll), _Axis(pitch)
            return
        self._roll.correct(roll, dt, self._config.memory)
        self._pitch.correct(pitch, dt, self._config.memory)

    def tilt(self, now: int) -> Tilt | None:
        """Tilt ``lead`` seconds after ``now`` (ns); None when the newest valid reading is stale."""
        if self._stamp is None:
            return None
        age = (now - self._stamp) / SECOND
        if age > self._config.stale_after:
            return None
        ahead = min(age + self._config.lead, self._config.coast)
        return Tilt(self._roll.ahead(ahead), self._pitch.ahead(ahead))


class StabiliserService:
    """Publishes joint goals on an absolute schedule.

    Args:
        config: limits, times.
        clock: time; the compass's stamps are of the same clock.
        compass: the body's tilt.
        odometry: its speeds.
        out: joint goals.
        name: service name.
    """

    def __init__(
        self,
        config: StabiliserConfig,
        clock: Clock,
        compass: Subscription[Attitude],
        odometry: Mailbox[Odometry],
        out: Publisher[StabiliserCommand],
        name: str = "levelling",
    ) -> None:
        self.name = name
        self._config = config
        self._clock = clock
        self._compass = compass
        self._odometry = odometry
        self._out = out

    async def run(self, ready: Ready) -> None:
        """Publish until cancelled."""
        ready()
        schedule = Schedule(self._clock, self._config.rate)
        tilt, body, joints, seen = TiltFilter(self._config), BodyAcceleration(self._config.felt), SQUARE, None
        while True:
            await schedule.next()
            for moved in self._odometry.drain():
                body.observe(moved)
            reading = self._compass.latest
            if reading is not None and reading is not seen:
                tilt.observe(reading, body.at(reading.stamp))
                seen = reading
            now = self._clock.now()
            joints = goals(tilt.tilt(now), joints, 1 / self._config.rate, self._config)
            seq = self._out.next_seq()
            self._out.put(StabiliserCommand(stamp=now, received=now, seq=seq, pitch=joints.pitch, roll=joints.roll))


def build_stabiliser(config: StabiliserConfig, clock: Clock, bus: BusPort) -> StabiliserService:
    """The service with its topics, for the catalog."""
    out = bus.publisher(PLAN_STABILISER, Writer.PLANNER)
    compass, odometry = bus.subscribe(COMPASS, latest()), bus.subscribe(ODOMETRY, fifo(KEPT))
    return StabiliserService(config, clock, compass, odometry, out)
