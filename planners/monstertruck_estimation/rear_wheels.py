"""Odometry of a tricycle from the encoders of its rear wheels, checked against its driven wheel.

The rear wheels are not driven, so they do not slip, and they give speed and yaw rate without the steering angle. The
driven front wheel also gives both, from its rate and angle: thdot = (v_s/d) sin(alpha). Over some distance both must
agree. An encoder that is stuck, mirrored or loose is rejected, and its measurements since the first disagreement are
undone. The other encoder is then combined with the yaw rate of the steering; without both encoders the front wheel is
used alone.
"""

import math
from collections import deque
from dataclasses import dataclass, replace
from typing import Annotated, Final, Literal, NamedTuple

from pydantic import Field

from monstertruck_estimation.inertial import Inertial
from monstertruck_estimation.odometry import (
    DeadReckoning,
    OdometryConfig,
    OdometryContext,
    OdometryService,
    PlanarCovariance,
)
from monstertruck_estimation.wheel_motion import WheelIncrement
from monstertruck_kinematics.chassis import TricycleChassis
from monstertruck_kinematics.se2 import Pose2, Twist2
from monstertruck_runtime.clock import SECOND
from monstertruck_runtime.errors import InputError
from monstertruck_runtime.mailbox import Mailbox, fifo
from monstertruck_runtime.ports import EventSink
from monstertruck_schemas import topics
from monstertruck_schemas.base import Positive, Schema
from monstertruck_schemas.event import Severity
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.sensor import DriveFeedback, WheelEncoders

Pair = tuple[float, float]
"""Values of the left and the right wheel."""

SIDES: Final = ("left", "right")
LATE: Final = SECOND // 5
"""Minimum interval between two readings with a missing one between them (ns)."""
KEPT_READINGS: Final = 256
"""Maximum numbers of stored readings and poses."""
STANDS: Final = 0.2
"""Share of the expected distance below which a wheel is considered stopped."""


class EncoderConfig(Schema):
    """Acceptance limits of the encoders."""

    stretch: Positive = 0.1
    """Distance over which rear wheels and driven wheel are compared (m)"""
    proof: Positive = 0.3
    """Distance for which a difference must last (m); until then the driven wheel moves the pose"""
    tolerance: Positive = 0.02
    """Tolerated difference (m)"""
    share: Annotated[float, Field(ge=0, lt=1)] = 0.12
    """Tolerated difference as a share of the greater distance: the driven wheel slips, and the steering lags"""


class RearWheelConfig(OdometryConfig):
    """Encoders of the rear wheels; other settings as for dead reckoning."""

    kind: Literal["encoders"] = "encoders"  # type: ignore[assignment]  # each kind has its own word
    encoders: EncoderConfig = EncoderConfig()
    """Acceptance limits of the encoders"""


class EncoderVerdict(NamedTuple):
    """Verdict on the encoders for one stretch."""

    trusted: tuple[bool, bool] = (True, True)
    slips: bool = False
    """The driven wheel slips, not the rear wheels."""
    text: str = ""

    @property
    def kind(self) -> tuple[tuple[bool, bool], bool, bool]:
        """Whether two verdicts are of the same kind and differ in figures only."""
        return self.trusted, self.slips, bool(self.text)


def judged(expected: Pair, counted: Pair, turned: float, least: float, config: EncoderConfig) -> EncoderVerdict | None:
    """Return the plausible encoders of both; None if the distance is too short.

    If both encoders agree with each other and with the steering, they are right, and the driven wheel slips. If both
    roll as far as the driven wheel on average, they are right too, and the steering angle is wrong.

    Args:
        expected: distances of the rear wheels from rate and angle of the front wheel (m).
        counted: distances by the encoders (m).
        turned: difference of right and left distance, from the counted mean and the steering alone (m).
        least: minimum distance of either wheel for a verdict (m).
        config: limits.
    """
    if max(map(abs, (*expected, *counted))) < least:
        return None

    def agree(one: float, other: float) -> bool:
        return abs(one - other) <= config.tolerance + config.share * max(abs(one), abs(other))

    right_ones = agree(counted[0], expected[0]), agree(counted[1], expected[1])
    if all(right_ones):
        return EncoderVerdict()
    if not any(right_ones) and agree(counted[0], expected[1]) and agree(counted[1], expected[0]):
        return EncoderVerdict((False, False), text="left and right encoders are swapped")
    rolled, driven = sum(counted) / 2, sum(expected) / 2
    if agree(rolled, driven) and not any(right_ones):
        text = f"the robot does not turn as steered: right minus left wheel {counted[1] - counted[0]:+.2f} m"
        return EncoderVerdict(text=f"{text}, expected from the steering {expected[1] - expected[0]:+.2f} m")
    if abs(counted[1] - counted[0] - turned) <= config.tolerance + config.share * abs(rolled):
        share = rolled / driven if abs(driven) > config.tolerance else math.inf
        # 1.5: maximum distance of both rear wheels as a share of the driven wheel's distance
        if STANDS < share <= 1.5 or share == math.inf:
            text = f"the rear wheels roll {rolled:.2f} m, the driven wheel {driven:.2f} m"
            return EncoderVerdict(slips=True, text=text)
    faults = [
        f"{side} {_fault(want, have, agrees=agree(have, -want))}"
        for side, want, have, right in zip(SIDES, expected, counted, right_ones, strict=True)
        if not right
    ]
    return EncoderVerdict(right_ones, text=", ".join(faults))


def _fault(want: float, have: float, *, agrees: bool) -> str:
    if abs(have) <= STANDS * abs(want):
        return "is stuck"
    return (
        "counts in the wrong direction"
        if agrees
        else f"rolls {have:.2f} m, expected from the driven wheel {want:.2f} m"
    )


@dataclass(frozen=True, slots=True)
class EncoderIncrement:
    """Distances of both wheels between two readings (m)."""

    since: int
    """Stamps of both readings (ns)."""
    stamp: int
    distances: Pair
    front: float
    """Mean steering angle (rad)."""


class Compared(NamedTuple):
    """Comparison of encoders and driven wheel over one motor reading."""

    since: int
    """Stamp of the motor reading (ns)."""
    distance: float
    """Distance of the wheel that rolled furthest, positive (m)."""
    expected: Pair
    """Distance by the driven wheel (m)."""
    counted: Pair
    """Distances by the encoders (m)."""
    turned: float
    """See ``judged``."""


class Encoders:
    """Latest readings of both encoders, and the trust in each.

    Args:
        config: limits.
        chassis: the robot's chassis.
    """

    def __init__(self, config: EncoderConfig, chassis: TricycleChassis) -> None:
        self.config = config
        self.verdict = EncoderVerdict()
        self._chassis = chassis
        self._rolled: deque[tuple[int, Pair]] = deque(maxlen=KEPT_READINGS)
        """Stamp (ns) and positions (m)."""
        self._compared: deque[Compared] = deque()
        self._since: int | None = None
        """Start of the stretch with the first difference (ns); None without one."""
        self._doubted = False
        """Whether the first difference points to an encoder fault."""

    @property
    def believed(self) -> tuple[bool, bool]:
        """Encoders that may determine the pose."""
        return (False, False) if self._doubted else self.verdict.trusted

    @property
    def stamp(self) -> int | None:
        """Stamp of the latest reading (ns)."""
        return self._rolled[-1][0] if self._rolled else None

    def observe(self, reading: WheelEncoders, front: float) -> EncoderIncrement | None:
        """Add a reading; return the distances since the last one, or None if unknown or not later."""
        radius = self._chassis.drivetrain.wheel_radius
        now = (reading.left * radius, reading.right * radius)
        before = self._rolled[-1] if self._rolled else None
        if not all(map(math.isfinite, now)) or (before is not None and reading.stamp <= before[0]):
            return None
        if before is not None and reading.stamp - before[0] > LATE:
            self._rolled.clear()
            self._compared.clear()
            before = None
        self._rolled.append((reading.stamp, now))
        if before is None:
            return None
        distances = now[0] - before[1][0], now[1] - before[1][1]
        return EncoderIncrement(before[0], reading.stamp, distances, front)

    def compare(self, roll: WheelIncrement) -> int | None:
        """Compare with the driven wheel.

        Returns:
            Start of the distrust of an encoder (ns); None without one.
        """
        start, end = self._at(roll.since), self._at(roll.stamp)
        if roll.lost or start is None or end is None:
            self._compared.clear()
            self._since, self._doubted = None, False
            return None
        left, right = self._chassis.rear_of_twist(roll.twist)
        expected, counted = (left * roll.dt, right * roll.dt), (end[0] - start[0], end[1] - start[1])
        distance = max(map(abs, (*expected, *counted)))
        if distance == 0.0:
            return None
        turned = sum(counted) * self._chassis.lean(roll.angles[0])
        self._compared.append(Compared(roll.since, distance, expected, counted, turned))
        return self._judge()

    def _judge(self) -> int | None:
        """Return the verdict on the latest stretch; a longer stretch must confirm a changed verdict."""
        compared, doubted, since = self._compared, self._doubted, self._since
        stretch = self.config.stretch if since is None else self.config.proof
        total = math.fsum(one.distance for one in compared)
        while total - compared[0].distance >= stretch:
            total -= compared.popleft().distance
        if since is not None and total < stretch:
            return None
        verdict = judged(
            (math.fsum(one.expected[0] for one in compared), math.fsum(one.expected[1] for one in compared)),
            (math.fsum(one.counted[0] for one in compared), math.fsum(one.counted[1] for one in compared)),
            math.fsum(one.turned for one in compared),
            stretch / 2,
            self.config,
        )
        if verdict is None:
            return None
        wrong = not all(verdict.trusted)
        if verdict.kind == self.verdict.kind:
            self._since, self._doubted = None, False
            return None
        if since is None:
            self._since, self._doubted = compared[0].since, wrong
        else:
            self._since, self._doubted, self.verdict = None, False, verdict
        begun = compared[0].since if since is None else since
        compared.clear()
        return begun if wrong and not doubted else None

    def _at(self, stamp: int) -> Pair | None:
        """Return the positions at an instant (m); None where unknown."""
        readings = self._rolled
        if len(readings) < 2 or stamp < readings[0][0] or stamp - readings[-1][0] > LATE:
            return None
        i = next(i for i in range(len(readings) - 1, 0, -1) if readings[i - 1][0] <= stamp)
        (since, before), (until, after) = readings[i - 1], readings[i]
        share = (stamp - since) / (until - since)
        return before[0] + share * (after[0] - before[0]), before[1] + share * (after[1] - before[1])


class RearWheelReckoning(DeadReckoning):
    """Dead reckoning from the rear wheels while they are trusted, otherwise from the driven wheel.

    Args:
        config: initial pose, noise and checks.
        chassis: the robot's chassis.
        inertial: inertial measurement unit whose yaw rate replaces the wheels'; None for the wheels alone.
    """

    def __init__(self, config: RearWheelConfig, chassis: TricycleChassis, inertial: Inertial | None = None) -> None:
        super().__init__(config, chassis, inertial)
        self.encoders = Encoders(config.encoders, chassis)
        self._tricycle = chassis
        self._front = 0.0
        self._increments: deque[EncoderIncrement] = deque(maxlen=KEPT_READINGS)
        self._rolls: deque[WheelIncrement] = deque(maxlen=KEPT_READINGS)
        self._kept: deque[tuple[int, Pose2, PlanarCovariance]] = deque(maxlen=KEPT_READINGS)
        """Stamp (ns), pose and covariance before each motion."""
        self._at: int | None = None
        """Stamp of the pose (ns)."""
        self._carrying: WheelIncrement | None = None
        """Latest motion by the encoders while they determine the pose; else None."""

    def observe_encoders(self, reading: WheelEncoders) -> None:
        """Add the angles of both rear wheels, and move the pose along their arc."""
        front = self._wheels.front
        increment = self.encoders.observe(reading, (self._front + front) / 2)
        self._front = front
        if increment is not None:
            self._increments.append(increment)
        self._go_on()

    def observe_drive(self, *shafts: DriveFeedback) -> None:
        """Add the position of the motor, which checks or replaces the encoders."""
        roll = self._wheels.observe_drive(*shafts)
        if self._at is None and self._wheels.known:
            self._at = self._wheels.stamp
        if roll is None:
            return
        self._rolls.append(roll)
        since = self.encoders.compare(roll)
        if since is not None:
            self._take_back(since)
        self._go_on()

    @property
    def _reached(self) -> int:
        return self._at or 0

    @property
    def _twist(self) -> Twist2:
        return self._wheels.twist if self._carrying is None else self._carrying.twist

    @property
    def _carriers(self) -> tuple[str, ...]:
        return ("drive",) if self._carrying is None else ("encoders", "drive")

    def _go_on(self) -> None:
        """Move the pose along all known motions."""
        while self._at is not None and (found := self._next(self._at)) is not None:
            roll, by_encoders = found
            self._kept.append((self._at, self._pose, self._covariance))
            self._move(roll)
            self._at = roll.stamp
            self._carrying = roll if by_encoders else None

    def _next(self, at: int) -> tuple[WheelIncrement, bool] | None:
        """Return the next motion from ``at`` on, and whether the encoders measured it; None if unknown."""
        until: int | None = None
        if self._heard() and any(self.encoders.believed):
            increment = next((increment for increment in self._increments if increment.stamp > at), None)
            if increment is None:
                return None
            if increment.since <= at:
                roll = self._by_encoders(increment)
                if roll is not None:
                    return _part(roll, at, increment.stamp), True
            until = increment.stamp if increment.since <= at else increment.since
        driven = next((roll for roll in self._rolls if roll.stamp > at), None)
        if driven is None:
            return None
        return _part(driven, at, driven.stamp if until is None else min(until, driven.stamp)), False

    def _heard(self) -> bool:
        """Whether the encoders' readings are as recent as the motor's."""
        newest = self.encoders.stamp
        return newest is not None and self._wheels.stamp - newest <= LATE

    def _by_encoders(self, increment: EncoderIncrement) -> WheelIncrement | None:
        """Return the motion by the trusted wheels; None if they did not measure it."""
        dt, lean = (increment.stamp - increment.since) / SECOND, self._tricycle.lean(increment.front)
        left, right = increment.distances[0] / dt, increment.distances[1] / dt
        trusted = self.encoders.believed
        if not all(trusted):
            speed, share = (left, 1.0 - lean) if trusted[0] else (right, 1.0 + lean)
            # 0.3: share of the axle's speed below which a wheel is not used alone: the robot turns about that wheel
            if abs(share) < 0.3:
                return None
            left, right = speed / share * (1.0 - lean), speed / share * (1.0 + lean)
        rolled = max(abs(left), abs(right)) * dt
        twist = self._tricycle.twist_of_rear(left, right)
        return WheelIncrement(increment.since, increment.stamp, twist, rolled, (twist[0],), (increment.front, 0.0))

    def _take_back(self, since: int) -> None:
        """Return to the pose at an instant (ns), or to the oldest stored pose."""
        for stamp, pose, covariance in self._kept:
            if stamp >= since:
                self._at, self._pose, self._covariance = stamp, pose, covariance
                self._kept.clear()
                self._turns.forget()
                if self._gyro is not None:
                    self._gyro.wheels_slipped(stamp)
                return


def _part(roll: WheelIncrement, since: int, stamp: int) -> WheelIncrement:
    """Return the part of a motion from ``since`` (or its start) to ``stamp``; an unknown motion is not divided."""
    since = max(since, roll.since)
    share = (stamp - since) / (roll.stamp - roll.since)
    return replace(roll, since=since, stamp=stamp, distance=roll.distance * share)


class EncoderInput:
    """Pass encoder messages to a ``RearWheelReckoning``, and report disagreement with the driven wheel.

    Args:
        reckoning: the estimator.
        measured: encoder readings.
        events: sink of the reports.
        source: source of the events.
    """

    def __init__(
        self, reckoning: RearWheelReckoning, measured: Mailbox[WheelEncoders], events: EventSink, source: str
    ) -> None:
        self._reckoning = reckoning
        self._measured = measured
        self._events = events
        self._source = source
        self._reported = EncoderVerdict()

    def take(self) -> None:
        """Pass new readings to the estimator."""
        for reading in self._measured.drain():
            self._reckoning.observe_encoders(reading)

    def report(self) -> None:
        """Report a changed verdict."""
        now, reported = self._reckoning.encoders.verdict, self._reported
        if now is reported:
            return
        self._reported = now
        wrong, was_wrong = (bool(verdict.text) and not verdict.slips for verdict in (now, reported))
        if now.slips:
            self._events(Reason.WHEEL_SLIP, Severity.WARNING, self._source, now.text)
        elif reported.slips:
            self._events(Reason.WHEEL_GRIP, Severity.INFO, self._source, "rear wheels and driven wheel agree again")
        if wrong:
            left, right = now.trusted
            carriers = "odometry uses the drive", f"odometry uses {SIDES[not left]} and steering", "odometry uses both"
            text = f"encoders of the rear wheels: {now.text}; {carriers[left + right]}"
            self._events(Reason.ENCODERS_DISAGREE, Severity.WARNING, self._source, text, left=left, right=right)
        elif was_wrong:
            self._events(Reason.ENCODERS_AGREE, Severity.INFO, self._source, "the encoders are used again")


def build_rear_wheels(config: RearWheelConfig, context: OdometryContext) -> OdometryService:
    """Build the service with its topics, for the catalog.

    Raises:
        InputError: the body has no rear wheels with encoders.
    """
    if not isinstance(context.chassis, TricycleChassis) or not context.encoders:
        raise InputError("odometry.kind encoders: expected body tricycle and the device encoders")
    imu = context.inertial(config.gyro)
    reckoning = RearWheelReckoning(config, context.chassis, None if imu is None else imu.inertial)
    measured = context.bus.subscribe(topics.ENCODERS, fifo(32))  # maximum number of queued readings
    events = context.bus.event_sink()
    encoders = EncoderInput(reckoning, measured, events, OdometryService.name)
    return OdometryService(
        reckoning, context.clock, imu=imu, encoders=encoders, events=events, rate=config.rate, **context.inputs()
    )
