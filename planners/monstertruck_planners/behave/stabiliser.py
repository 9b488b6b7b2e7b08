"""Lidar stabiliser: converts the body's tilt into goals for the mount's two joints.

**Convention.** All angles are REP 103: pitch about y, nose down positive; roll about x, right side down positive.
The compass gives the body's tilt in a level frame as R = Ry(pitch) Rx(roll), heading left out. The mount's pitch
joint sits on the body, its roll joint on the pitch joint, the lidar on the roll joint: M = Ry(a) Rx(b). The lidar is
level when the third row of R M is (0, 0, 1): its own up axis, M z, is then the body's view of up,
u = R^T z = (-sin p, sin r cos p, cos r cos p). With M z = (sin a cos b, -sin b, cos a cos b) that gives

    b = -asin(sin r cos p),   a = -atan2(sin p, cos r cos p).

For tilt about one axis, the joint takes the opposite angle. For tilt about both, a heading of second order remains
(4 degrees at 15 and 15 degrees); users of the scan compute it from the joint angles.

**Prediction.** A compass reading is already old on arrival, and a joint reaches its goal late. If the body rocks by 15
degrees at 0.5 Hz, every 10 ms of delay cause an error of up to half a degree. Therefore a filter with constant
acceleration (the fading-memory polynomial filter of second degree, also called critically damped g-h-k; see Brookner,
"Tracking and Kalman Filtering Made Easy") tracks the tilt and predicts it for the time when the joints reach their
goals.

A filter with a short memory follows a rocking body, but on smooth ground it triples the noise of the compass and of
odometry (see below). Therefore several filters with different memories run in parallel, each weighted by its recent
errors in predicting readings ``JUDGED`` readings ahead.

**Driving.** The acceleration of the body is removed from the compass's tilt (``monstertruck_estimation.body_tilt``),
because the prediction would double its effect.
"""

import math
from collections import deque
from typing import Annotated, Final, Literal, NamedTuple

import numpy as np
from pydantic import Field

from monstertruck_estimation.body_tilt import KEPT_ODOMETRY, BodyAcceleration, Tilt
from monstertruck_kinematics.elementary import Array, clip
from monstertruck_runtime.clock import SECOND, Clock, Schedule
from monstertruck_runtime.mailbox import Mailbox, fifo, latest
from monstertruck_runtime.ports import BusPort, Publisher, Ready, Subscription
from monstertruck_schemas.base import Positive, Schema
from monstertruck_schemas.plan import StabiliserCommand
from monstertruck_schemas.roles import ServiceName
from monstertruck_schemas.sensor import Attitude
from monstertruck_schemas.state import Odometry
from monstertruck_schemas.topics import COMPASS, ODOMETRY, PLAN_STABILISER, Writer

FILTERS: Final = 5
JUDGED: Final = 2
"""Prediction length that is checked, in readings: about as far ahead as predictions are used."""
LEAST_ERROR: Final = math.radians(0.1)
"""Error below which filters are equally good (rad): the compass resolution."""

Limit = Annotated[float, Field(gt=0, lt=math.pi / 2)]


class StabiliserConfig(Schema):
    """Settings of the lidar stabiliser."""

    kind: Literal["stabiliser"] = "stabiliser"
    rate: Annotated[float, Field(gt=0, le=100)] = 25.0
    """Goals per second."""
    pitch_limit: Limit = math.radians(30)
    """Maximum joint angle to either side, rad."""
    roll_limit: Limit = math.radians(30)
    """Maximum joint angle to either side, rad."""
    max_rate: Positive = 3.0
    """Maximum rate of change of a goal, rad/s."""
    lead: Annotated[float, Field(ge=0, le=0.5)] = 0.036
    """Delay of a joint behind its goal, s: servo, bus and half a goal period."""
    memory: Annotated[float, Field(gt=0, lt=1)] = 0.4
    """Fraction of the past that one reading leaves in the fastest filter; more is smoother but later."""
    coast: Positive = 0.2
    """Maximum prediction time beyond the latest tilt reading, s."""
    stale_after: Positive = COMPASS.fresh_for()
    """Maximum time without valid tilt, s; the joints then return to 0."""


class Joints(NamedTuple):
    """Joint angles of the mount (rad), REP 103."""

    pitch: float
    roll: float


SQUARE = Joints(0.0, 0.0)
"""Lidar parallel to the body."""


def level(tilt: Tilt) -> Joints:
    """Return the joint angles that level the lidar; see the module."""
    p, r = tilt.pitch, tilt.roll
    return Joints(pitch=-math.atan2(math.sin(p), math.cos(r) * math.cos(p)), roll=-math.asin(math.sin(r) * math.cos(p)))


def goals(tilt: Tilt | None, before: Joints, dt: float, config: StabiliserConfig) -> Joints:
    """Return the next goals: towards a level lidar, or to 0 without a tilt.

    Args:
        tilt: tilt of the body when the joints will have followed; None if unknown.
        before: goals ``dt`` s earlier.
        dt: time step (s).
        config: limits.
    """
    wanted = SQUARE if tilt is None else level(tilt)
    step = config.max_rate * dt
    return Joints(
        pitch=_towards(before.pitch, clip(wanted.pitch, -config.pitch_limit, config.pitch_limit), step),
        roll=_towards(before.roll, clip(wanted.roll, -config.roll_limit, config.roll_limit), step),
    )


def _towards(before: float, wanted: float, step: float) -> float:
    return before + clip(wanted - before, -step, step)


class TiltFilter:
    """Filter that tracks and predicts valid tilt, weighting filters by their recent predictions; see the module.

    Args:
        config: memory and times.
    """

    def __init__(self, config: StabiliserConfig) -> None:
        self._config = config
        self._stamp: int | None = None
        # 0.6: ratio of the forgetting rates of successive filters
        self._forget: Array = np.asarray((1 - config.memory) * 0.6 ** np.arange(FILTERS, dtype=np.float64))[:, None]
        self._past: deque[tuple[int, Array]] = deque(maxlen=JUDGED)
        """Stamps and states after the latest readings: angle, rate, acceleration; shape (3, filters, 2 axes)."""
        self._errors = np.zeros((FILTERS, 2))
        """Mean squared prediction errors of the filters over that many readings (rad^2)."""

    def observe(self, attitude: Attitude, body: BodyAcceleration | None = None) -> None:
        """Process a reading; skip invalid and older readings, restart after a gap.

        Args:
            attitude: reading.
            body: acceleration of the body, if known.
        """
        if not attitude.tilt_valid or (self._stamp is not None and attitude.stamp <= self._stamp):
            return
        dt = math.inf if self._stamp is None else (attitude.stamp - self._stamp) / SECOND
        self._stamp = attitude.stamp
        measured = np.array((BodyAcceleration() if body is None else body).tilt(attitude))
        if dt > self._config.stale_after:
            self._past.clear()
            self._errors[:] = 0.0
            state = np.zeros((3, FILTERS, 2))
            state[0] = measured
        else:
            if len(self._past) == JUDGED:
                before, old = self._past[0]
                missed = measured - _ahead(old, (attitude.stamp - before) / SECOND)
                # 0.1: weight of the latest reading in a filter's errors
                self._errors += 0.1 * (missed**2 - self._errors)
            state = _corrected(self._past[-1][1], measured, dt, self._forget)
        self._past.append((attitude.stamp, state))

    def tilt(self, now: int) -> Tilt | None:
        """Return the tilt ``lead`` s after ``now`` (ns); None if the latest valid reading is stale."""
        if self._stamp is None:
            return None
        age = (now - self._stamp) / SECOND
        if age > self._config.stale_after:
            return None
        # 4: power of the mean square that decides how fast a less accurate filter loses weight
        weights = (self._errors + LEAST_ERROR**2) ** -4
        predicted = _ahead(self._past[-1][1], min(age + self._config.lead, self._config.coast))
        roll, pitch = ((weights * predicted).sum(axis=0) / weights.sum(axis=0)).tolist()
        return Tilt(roll, pitch)


def _ahead(state: Array, dt: float) -> Array:
    angle, rate, acceleration = state
    return np.asarray(angle + dt * (rate + dt * acceleration / 2))


def _corrected(state: Array, measured: Array, dt: float, forget: Array) -> Array:
    """Return the state after a reading ``dt`` s later, for filters that forget a fraction of the past per reading."""
    off = measured - _ahead(state, dt)
    _, rate, acceleration = state
    return np.stack(
        (
            measured - (1 - forget) ** 3 * off,
            rate + dt * acceleration + 1.5 * forget**2 * (2 - forget) * off / dt,
            acceleration + forget**3 * off / dt**2,
        )
    )


class StabiliserService:
    """Service that publishes joint goals on an absolute schedule.

    Args:
        config: limits, times.
        clock: clock, also used for the compass stamps.
        compass: subscription to the body's tilt.
        odometry: subscription to the body's speeds.
        out: publisher of joint goals.
        name: service name.
    """

    def __init__(
        self,
        config: StabiliserConfig,
        clock: Clock,
        compass: Subscription[Attitude],
        odometry: Mailbox[Odometry],
        out: Publisher[StabiliserCommand],
        name: str = ServiceName.LEVELLING.value,
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
        tilt, body, joints, seen = TiltFilter(self._config), BodyAcceleration(), SQUARE, None
        while True:
            await schedule.next()
            for moved in self._odometry.drain():
                body.observe(moved)
            reading = self._compass.latest
            if reading is not None and reading is not seen:
                tilt.observe(reading, body)
                seen = reading
            now = self._clock.now()
            joints = goals(tilt.tilt(now), joints, 1 / self._config.rate, self._config)
            seq = self._out.next_seq()
            self._out.put(StabiliserCommand(stamp=now, received=now, seq=seq, pitch=joints.pitch, roll=joints.roll))


def build_stabiliser(config: StabiliserConfig, clock: Clock, bus: BusPort) -> StabiliserService:
    """Build the service with its topics, for the catalog."""
    out = bus.publisher(PLAN_STABILISER, Writer.PLANNER)
    compass, odometry = bus.subscribe(COMPASS, latest()), bus.subscribe(ODOMETRY, fifo(KEPT_ODOMETRY))
    return StabiliserService(config, clock, compass, odometry, out)
