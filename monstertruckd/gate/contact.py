"""Detects contact while an operator drives into ground that no lidar has seen, and backs off.

Four measurements show that an obstacle holds the body while its wheels are driven: a motor draws more than its rolling
current, a shaft or a free wheel is slower than commanded, the body turns less than commanded, or the scans show that
the body stands still while its wheels roll. The gate compares them only while the commanded motion is steady, because a
motor that accelerates its gears draws as much current as a motor that pushes. After a contact the gate reverses the
last motion for a few centimetres. Then the robot waits until the operator releases the stick or requests another
direction.
"""

import math
from collections import deque
from collections.abc import Iterator, Sequence
from statistics import median, pstdev
from typing import Any, Final, NamedTuple

from monstertruck_kinematics.chassis import STILL
from monstertruck_kinematics.se2 import Twist2
from monstertruck_runtime.clock import SECOND
from monstertruck_schemas.base import Message
from monstertruck_schemas.event import Measurement
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import DriveRequest
from monstertruck_schemas.sensor import DriveFeedback, DriveMode, Imu, WheelEncoders
from monstertruck_schemas.state import Consistency, StandingBody
from monstertruck_schemas.topics import CONSISTENCY, DRIVES, ENCODERS, IMU, Topic
from monstertruckd.gate.checks import Check, GateView, PaceLimit, Tick
from monstertruckd.gate.config import ContactConfig
from monstertruckd.gate.motion import Course, scaled

SETTLED: Final = SECOND // 10
"""Time a shaft must hold its commanded speed before measures are compared, ns."""


class ContactFinding(NamedTuple):
    """Measurement that revealed a contact."""

    name: str
    """Name of the measure."""
    value: float
    unit: str
    limit: float


class Lasting:
    """A condition that must hold for some time, measured by the stamps of the messages that show it."""

    def __init__(self) -> None:
        self._since: int | None = None

    def holds(self, now: int, within: float, *, true: bool) -> bool:
        """Update with ``true`` at ``now`` (ns); return whether the condition has held for ``within`` s."""
        if not true:
            self._since = None
            return False
        self._since = now if self._since is None else self._since
        return now - self._since >= within * SECOND


class ContactCheck(Check):
    """Detects that an obstacle holds the body while an operator drives into unseen ground, and backs off.

    Args:
        view: read access to the gate's state.
        config: limits, and the distance to back off.
    """

    reasons = (Reason.CONTACT,)
    reads = (IMU, ENCODERS, CONSISTENCY)

    def __init__(self, view: GateView, config: ContactConfig) -> None:
        super().__init__(view)
        self._config = config
        self._steady: Twist2 = STILL
        """Commanded motion."""
        self._reached: dict[int, int] = {}
        """Time when each shaft reached its commanded speed, ns."""
        self._rolling: dict[int, deque[float]] = {}
        """Latest motor currents of each shaft while the robot rolled freely, positive along the motion, A."""
        self._readings: dict[int, float] = {}
        """Latest motor current of each shaft, also at other speeds, A."""
        self._steps: dict[int, float] = {}
        """Smallest difference between two successive readings of each shaft's current, A: their resolution."""
        self._slow: dict[str, Lasting] = {}
        self._encoders: WheelEncoders | None = None
        self._request: DriveRequest | None = None
        """Latest request of the holder."""
        self._touched: DriveRequest | None = None
        """Request in force when the robot made contact; None without a contact."""
        self._finding: ContactFinding | None = None
        self._began = 0
        """Time when the robot began to back off, ns."""
        self._backed = 0.0
        """Distance backed off, m."""

    def observe(self, seen: Message | Tick, topic: Topic[Any] | None) -> None:
        """Process the commanded motion of a tick, or a measurement of the actual motion."""
        match seen:
            case Tick():
                self._follow(seen)
            case DriveFeedback() if topic is not None:
                self._take_drive(seen, DRIVES.index(topic))
            case WheelEncoders():
                self._take_encoders(seen)
            case Imu():
                self._take_gyro(seen)
            case Consistency(standing=StandingBody() as body) if self._driven(body.since):
                least = self._config.share * body.rolled
                self._touch(ContactFinding("distance by the scans", body.shown, "m", least), seen.received)

    def instead(self, request: DriveRequest, now: int) -> DriveRequest:
        """Return the request to drive: the holder's request or, after a contact, the opposite motion."""
        self._request = request
        touched = self._touched
        if touched is None:
            return request
        if not any(request.numbers.values()) or not self._same_direction(request, touched):
            self._touched = None
            return request
        return self._opposite(touched) if self._backing(now) else request

    def limit(self, now: int, courses: Sequence[Course] | None) -> Iterator[PaceLimit]:
        """Limit the pace while the robot backs off, then keep it at standstill."""
        if courses is None:
            self._touched = self._request = None
        elif self._touched is not None:
            yield PaceLimit(Reason.CONTACT, self.view.config.obstacle.confirmed_speed if self._backing(now) else 0.0)

    def figures(self, reason: Reason, now: int) -> Iterator[Measurement]:
        """Measurement that revealed the contact."""
        if (found := self._finding) is not None:
            yield Measurement(name=found.name, value=found.value, unit=found.unit, limit=found.limit)

    # The commanded motion

    def _follow(self, tick: Tick) -> None:
        twist = self.view.motion.twist
        steady = 1e-3  # maximum difference of equal commanded motions, m/s and rad/s
        if max(abs(new - old) for new, old in zip(twist, self._steady, strict=True)) > steady:
            self._steady = twist
            self._reached.clear()
            self._slow.clear()
        if self._touched is not None:
            speeds = self.view.samples.shaft_speeds(tick.now)
            away = self._away(self.view.motion.shaft_speeds)
            self._backed += away * max(map(abs, speeds), default=0.0) * tick.elapsed / SECOND

    def _away(self, speeds: Sequence[float]) -> bool:
        """Return whether commanded shaft speeds lead away from the contact."""
        assert self._touched is not None
        towards = self.view.chassis.shafts_along(self.view.motion.target(self._touched).twist, *self.view.motion.angles)
        return sum(speed * other for speed, other in zip(speeds, towards, strict=True)) < 0.0

    def _backing(self, now: int) -> bool:
        """Return whether the robot still has to back off."""
        distance = self._config.back_off
        # The robot stops backing off after this multiple of the travel time for the distance at ``confirmed_speed``.
        patience = 2.0
        longest = patience * distance / self.view.config.obstacle.confirmed_speed
        return self._backed < distance and now - self._began < longest * SECOND

    def _same_direction(self, request: DriveRequest, other: DriveRequest) -> bool:
        return self._leads(request, self.view.motion.target(other).twist)

    def _leads(self, request: DriveRequest, twist: Twist2) -> bool:
        """Return whether a request has the same direction as a twist."""
        asked = self.view.motion.target(request).twist
        return sum(a * b for a, b in zip(asked, twist, strict=True)) > 0.0

    def _opposite(self, request: DriveRequest) -> DriveRequest:
        """Return the opposite of a request, at ``confirmed_speed``."""
        target = self.view.motion.target(request)
        pace = self.view.motion.pace(target.twist, target.shafts)
        least = 1e-6  # minimum pace of a request that is scaled, m/s
        share = -self.view.config.obstacle.confirmed_speed / max(pace, least)
        if request.twist is not None:
            vx, vy, wz = scaled((request.twist.vx, request.twist.vy, request.twist.wz), share)
            return request.model_copy(update={"twist": request.twist.model_copy(update={"vx": vx, "vy": vy, "wz": wz})})
        if request.shafts is not None:
            return request.model_copy(update={"shafts": tuple(share * rate for rate in request.shafts)})
        return request.model_copy(update={"speed": share * request.speed})

    # The measures

    def _driven(self, stamp: int) -> bool:
        """Return whether, at ``stamp`` (ns), all shafts have held the speeds of a steady motion for ``SETTLED``."""
        reached = self._reached.values()
        return len(reached) == len(self.view.motion.shaft_speeds) and stamp - max(reached) >= SETTLED

    def _take_drive(self, feedback: DriveFeedback, shaft: int) -> None:
        if feedback.current is not None:
            step = abs(feedback.current - self._readings.get(shaft, feedback.current))
            if step:
                self._steps[shaft] = min(step, self._steps.get(shaft, step))
            self._readings[shaft] = feedback.current
        commanded = self.view.motion.shaft_speeds[shaft]
        if self._touched is not None or feedback.mode is not DriveMode.ENABLED or not commanded:
            self._reached.pop(shaft, None)
            return
        sign = math.copysign(1.0, commanded)
        measured = sign * self.view.chassis.drivetrain.speed(feedback.velocity)
        # Fraction of the commanded speed taken as reached; a drive just switched on needs half a second for it.
        reached = 0.8
        if measured >= reached * abs(commanded):
            self._reached.setdefault(shaft, feedback.stamp)
        if feedback.stamp - self._reached.get(shaft, feedback.stamp) < SETTLED:
            return
        self._compare(f"shaft {shaft}", feedback, measured, abs(commanded))
        if feedback.current is not None:
            known = self._rolling.setdefault(shaft, deque(maxlen=20))  # number of rolling currents kept for each motor
            enough = 10  # number of rolling currents that replace ``ContactConfig.rolling``
            measured_it, near = len(known) >= enough, self.view.confirmed or self.view.dock is not None
            usual = known if measured_it else (self._config.rolling,)
            limit = _current_limit(usual, self._config.rise, self._steps.get(shaft, 0.0))
            load = sign * feedback.current
            # Elsewhere the robot first measures its rolling current, which differs between motors.
            if load > limit and (measured_it or near):
                self._touch(ContactFinding("motor current", load, "A", limit), feedback.received)
            else:
                known.append(load)

    def _take_encoders(self, encoders: WheelEncoders) -> None:
        before, self._encoders = self._encoders, encoders
        if before is None or encoders.stamp <= before.stamp or not self._driven(before.stamp):
            self._slow.pop("free wheels", None)
            return
        seconds, radius = (encoders.stamp - before.stamp) / SECOND, self.view.chassis.drivetrain.wheel_radius
        turned = max(abs(encoders.left - before.left), abs(encoders.right - before.right))
        vx, vy, _ = self._steady
        self._compare("free wheels", encoders, turned * radius / seconds, math.hypot(vx, vy))

    def _take_gyro(self, imu: Imu) -> None:
        expected = abs(self._steady[2])
        turning = 0.1  # minimum commanded yaw rate that is compared with the gyroscope, rad/s
        if not self._driven(imu.stamp) or expected < turning:
            self._slow.pop("body", None)
            return
        rate = imu.angular_velocity
        self._compare("body", imu, math.hypot(rate.x, rate.y, rate.z), expected, "rad/s")

    def _compare(self, name: str, seen: Message, measured: float, expected: float, unit: str = "m/s") -> None:
        """Start to back off if a speed stays far below the expected speed."""
        least = self._config.share * expected
        slow = self._slow.setdefault(name, Lasting())
        if slow.holds(seen.stamp, self._config.within, true=measured < least):
            self._touch(ContactFinding(f"speed of {name}", measured, unit, least), seen.received)

    def _touch(self, found: ContactFinding, now: int) -> None:
        """Start to back off if the robot drives into unseen ground or near a dock, but not away from the contact."""
        view = self.view
        blind = view.operated and not view.samples.scan_fresh(now)
        if (
            (blind or view.confirmed or view.dock is not None)
            and self._request is not None
            and self._leads(self._request, self._steady)
        ):
            self._touched, self._finding, self._began, self._backed = self._request, found, now, 0.0
            self._reached.clear()
            self._slow.clear()


def _current_limit(rolling: Sequence[float], rise: float, step: float) -> float:
    """Return the current limit (A): the rolling current, plus the fraction ``rise`` of it, plus its noise.

    Downhill, the motor draws hardly any current, or brakes, so the noise determines the limit. Readings of 0 hide noise
    below half their resolution ``step`` (A), so the rounding error is counted as noise.
    """
    usual, noise, sigmas = median(rolling), pstdev(rolling), 5.0  # significance
    if not usual:
        noise = math.hypot(noise, step / math.sqrt(12.0))
    return usual + max(rise * abs(usual), sigmas * noise)
