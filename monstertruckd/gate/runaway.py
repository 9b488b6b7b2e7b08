"""Uncommanded motion: compares drive feedback with the speeds that the orders allow.

A shaft may turn no faster than the fastest order in force. A superseded order stays in force until feedback arrives
later than the reaction time after the new order: a drive that does not answer may not have received the new order
either. If the shaft turns faster than its orders allow, the bound falls at the minimum deceleration of the drive's own
ramp. ``ShaftBounds`` holds the forward and the backward bound. The criterion is the distance that a shaft turns beyond
its bounds: a short overshoot moves nothing, but a lasting slow creep does.

Only motion caused by a motor is judged. A power stage that is off and draws no current turns nothing: the robot is
being pushed, or it rolls. If a drive does not measure its current, all its motion is judged.
"""

import math
from collections import deque
from collections.abc import Iterator
from enum import IntEnum, StrEnum
from typing import Any, Final, NamedTuple

from monstertruck_runtime.clock import SECOND
from monstertruck_schemas.base import Message
from monstertruck_schemas.event import Measurement
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.roles import DeviceRole
from monstertruck_schemas.sensor import DriveFeedback, DriveMode, Imu, StabiliserFeedback, WheelEncoders
from monstertruck_schemas.state import Consistency, GateMode, UnshownMotion
from monstertruck_schemas.topics import CONSISTENCY, DRIVES, ENCODERS, IMU, SCAN, STABILISER, Topic
from monstertruckd.gate.checks import Check, GateView, Tick
from monstertruckd.gate.config import RunawayConfig

POWERED: Final = frozenset({DriveMode.ENABLED, DriveMode.QUICK_STOP})
"""Modes of a drive whose power stage is on."""
MAX_ORDERS: Final = 64
"""Maximum number of separate orders; older ones are merged into their bounds."""
LEAK: Final = 0.1
"""Tolerated permanent drift of a shaft ordered to stand, as a fraction of the standstill speed."""


class RunawayKind(StrEnum):
    """How a motion departs from the orders; the value is the text for messages."""

    NO_ORDER = "turns without a command"
    DOES_NOT_STOP = "does not stop"
    TOO_FAST = "turns faster than commanded"
    OPPOSITE = "turns opposite to its command"
    VELOCITY_LIES = "turns according to its position while its velocity reads 0"
    BODY_MOVES = "reports standstill while the body moves"
    STRAYS = "moved away from its target by itself"


class Runaway(NamedTuple):
    """An uncommanded motion."""

    kind: RunawayKind
    source: str
    """Drive or other sensor that measured the motion."""
    measured: float
    """Speed over ground, m/s."""
    low: float
    """Minimum speed allowed by the orders, m/s."""
    high: float
    """Maximum speed allowed by the orders, m/s."""

    @property
    def text(self) -> str:
        """Text for messages."""
        if self.kind is RunawayKind.STRAYS:
            return f"{self.source} {self.kind}"
        return f"{self.source} {self.kind} at {self.measured:.3f} m/s"


class _Order(NamedTuple):
    """Speed ordered since ``since`` (ns), or the bounds of several merged orders (m/s)."""

    since: int
    low: float
    high: float


class _Beyond(NamedTuple):
    """Accumulated distance beyond the allowed distance (m)."""

    velocity: float = 0.0
    """Integrated from the velocity."""
    position: float = 0.0
    """Measured by the position."""
    drift: float = 0.0
    """Measured by the position while the shaft is ordered to stand, less a tolerated slow drift."""
    unread: float = 0.0
    """Measured by the position while the velocity reads 0."""


class ShaftBounds:
    """Speeds allowed by the orders to a shaft (m/s, forward positive); ``low`` <= 0 <= ``high``."""

    def __init__(self) -> None:
        self.low = 0.0
        self.high = 0.0
        self.furthest = 0.0
        """Maximum speed allowed at any time between the last two measurements, m/s."""
        self.rearmost = 0.0
        """Minimum speed allowed at any time between the last two measurements, m/s."""
        self._orders: deque[_Order] = deque([_Order(0, 0.0, 0.0)])

    @property
    def ordered(self) -> float:
        """Latest order (m/s)."""
        newest = self._orders[-1]
        return newest.high if newest.high > 0.0 else newest.low

    @property
    def steady(self) -> bool:
        """Whether a single order was in force between the last two measurements."""
        return len(self._orders) == 1

    def order(self, now: int, speed: float) -> None:
        """Add an order for ``speed`` (m/s) at ``now`` (ns)."""
        newest, orders = self._orders[-1], self._orders
        if (newest.low, newest.high) == (speed, speed):
            return
        orders.append(_Order(now, speed, speed))
        if len(orders) > MAX_ORDERS:
            first, second = orders.popleft(), orders.popleft()
            orders.appendleft(_Order(first.since, min(first.low, second.low), max(first.high, second.high)))

    def follow(self, before: int, stamp: int, reaction: float, deceleration: float) -> None:
        """Update the bounds from one measurement to the next.

        Args:
            before: stamp of the previous measurement (ns).
            stamp: stamp of this measurement (ns).
            reaction: time from an order to its effect (s).
            deceleration: minimum deceleration of the drive's ramps (m/s^2).
        """
        heard = before - round(reaction * SECOND)
        while len(self._orders) > 1 and self._orders[1].since <= heard:
            self._orders.popleft()
        change = deceleration * (stamp - before) / SECOND
        high, low = self.high, self.low
        self.high = max(0.0, high - change, *(order.high for order in self._orders))
        self.low = min(0.0, low + change, *(order.low for order in self._orders))
        self.furthest, self.rearmost = max(high, self.high), min(low, self.low)

    def begin(self, speed: float) -> None:
        """Restart the bounds at a measured speed (m/s), whatever caused it."""
        self.high, self.low = max(speed, 0.0), min(speed, 0.0)


class ShaftWatch:
    """Compares one shaft's feedback with its orders.

    Args:
        name: name of the drive.
    """

    def __init__(self, name: str) -> None:
        self.bounds = ShaftBounds()
        self.moves = False
        """Whether velocity or position of the latest feedback show motion."""
        self.still_since: int | None = None
        """Stamp of the first feedback without motion, ns; None while the shaft moves."""
        self.driven = False
        """Whether the motor may turn the shaft, by the latest feedback."""
        self.powered_since = 0
        """Stamp of the last feedback with the power stage off before it was switched on, ns; 0 while it is off."""
        self._name = name
        self._before: DriveFeedback | None = None
        self.measures_current = False
        """Whether the drive measures its current, which shows if the motor may turn the shaft."""
        self._current: float | None = None
        """Latest current in this mode, A."""
        self._rested = False
        """Whether the shaft has been at rest since the last order to turn."""
        self._over = 0.0
        """Excess over the allowed speed at the latest feedback, m/s."""
        self._beyond = _Beyond()

    def observe(
        self,
        feedback: DriveFeedback,
        metres: float,
        config: RunawayConfig,
        reaction: float,
        deceleration: float,
        standstill: float,
    ) -> Runaway | None:
        """Process feedback; return an uncommanded motion, once.

        Args:
            feedback: feedback from the shaft.
            metres: distance over ground per radian of the motor (m).
            config: limits.
            reaction: time from an order to its effect (s).
            deceleration: minimum deceleration of the drive's ramps (m/s^2).
            standstill: speed below which a shaft is at rest (m/s).
        """
        before, self._before = self._before, feedback
        velocity = feedback.velocity * metres
        if feedback.mode not in POWERED:
            self.powered_since = 0
        elif before is not None and before.mode not in POWERED:
            self.powered_since = before.stamp
        self._take_current(feedback, before)
        driven = self.driven = self._is_driven(feedback, config)
        if before is None or feedback.stamp <= before.stamp:
            self._begin(velocity)
            self._note_motion(feedback, moves=abs(velocity) >= standstill)
            return None
        dt = (feedback.stamp - before.stamp) / SECOND
        step = (feedback.position - before.position) * metres
        self._note_motion(feedback, moves=max(abs(velocity), abs(step) / dt) >= standstill)
        if not driven:
            self._begin(velocity)
            return None
        self.bounds.follow(before.stamp, feedback.stamp, reaction, deceleration)
        if self.bounds.ordered:
            self._rested = False
        elif not self.moves:
            self._rested = True
        return self._judge(velocity, before.velocity * metres, step, dt, config.distance, standstill)

    def pulls(self, config: RunawayConfig, *, fresh: bool) -> bool:
        """Return whether the motor may be moving the body, even if the shaft reads standstill.

        Args:
            config: limits.
            fresh: whether the drive's feedback is fresh.
        """
        if not fresh or not self.measures_current:
            return self._before is not None and self._before.mode in POWERED
        return self._current is not None and abs(self._current) > config.idle_current

    def _note_motion(self, feedback: DriveFeedback, *, moves: bool) -> None:
        self.moves = moves
        if moves:
            self.still_since = None
        elif self.still_since is None:
            self.still_since = feedback.stamp

    def _take_current(self, feedback: DriveFeedback, before: DriveFeedback | None) -> None:
        if before is None or before.mode is not feedback.mode:
            self._current = None
        if feedback.current is not None:
            self.measures_current, self._current = True, feedback.current

    def _is_driven(self, feedback: DriveFeedback, config: RunawayConfig) -> bool:
        """Return whether the motor may be turning the shaft; a current not yet measured in this mode shows nothing."""
        if feedback.mode in POWERED or not self.measures_current:
            return True
        return self._current is not None and abs(self._current) > config.idle_current

    def _begin(self, velocity: float) -> None:
        self.bounds.begin(velocity)
        self._over = 0.0
        self._beyond = _Beyond()

    def _judge(
        self, velocity: float, before: float, step: float, dt: float, distance: float, standstill: float
    ) -> Runaway | None:
        bounds, so_far = self.bounds, self._beyond
        over, was = max(velocity - bounds.high, bounds.low - velocity) - standstill, self._over
        self._over = over
        further = max(step - bounds.furthest * dt, bounds.rearmost * dt - step) - standstill * dt
        drift = 0.0
        if bounds.rearmost == bounds.furthest == 0.0:
            leak = LEAK * standstill * dt
            drift = so_far.drift + step
            drift = max(drift - leak, 0.0) if drift > 0.0 else min(drift + leak, 0.0)
        reads_rest = max(abs(velocity), abs(before)) < standstill
        unread = reads_rest and bounds.steady and abs(step) > standstill * dt
        self._beyond = found = _Beyond(
            velocity=so_far.velocity + max(min(over, was), 0.0) * dt if over > 0.0 else 0.0,
            position=so_far.position + further if further > 0.0 else 0.0,
            drift=drift,
            unread=so_far.unread + abs(step) if unread else 0.0,
        )
        if max(map(abs, found)) <= distance:
            return None
        measured = step / dt if reads_rest else velocity
        runaway = Runaway(self._kind(measured), self._name, measured, bounds.low, bounds.high)
        self._begin(measured)
        return runaway

    def _kind(self, measured: float) -> RunawayKind:
        ordered = self.bounds.ordered
        if self._beyond.unread:
            return RunawayKind.VELOCITY_LIES
        if ordered == 0.0:
            return RunawayKind.NO_ORDER if self._rested else RunawayKind.DOES_NOT_STOP
        return RunawayKind.OPPOSITE if measured * ordered < 0.0 else RunawayKind.TOO_FAST


class BodyWatch:
    """Watches the body with a sensor independent of the drives, while all drives are ordered to stand.

    Args:
        source: role of the sensor.
        fresh_for: age above which its latest sample is ignored (s).
    """

    def __init__(self, source: str, fresh_for: float) -> None:
        self._source = source
        self._fresh_for = round(fresh_for * SECOND)
        self._stamp: int | None = None
        self._travel = 0.0
        self.runs = False
        """Whether the latest sample shows motion that a motor may cause."""

    def observe(
        self, stamp: int, speed: float, config: RunawayConfig, standstill: float, *, standing: bool, driven: bool
    ) -> Runaway | None:
        """Process a speed; return an uncommanded motion, once.

        Args:
            stamp: time stamp of the sample (ns).
            speed: speed of the body or of a free wheel (m/s).
            config: limits.
            standstill: speed below which the robot is at rest (m/s).
            standing: whether all drives are ordered to stand and have had time to obey.
            driven: whether a motor may be moving the robot.
        """
        before, self._stamp = self._stamp, stamp
        moves = abs(speed) >= standstill
        self.runs = driven and moves
        if before is None or not standing or not moves:
            self._travel = 0.0
            return None
        self._travel += abs(speed) * (stamp - before) / SECOND  # also before a current is measured
        if not driven or self._travel <= config.body_distance:
            return None
        self._travel = 0.0
        return Runaway(RunawayKind.BODY_MOVES, self._source, speed, 0.0, 0.0)

    def observe_window(
        self, since: int, stamp: int, moved: float, config: RunawayConfig, *, stood: int, now: int, driven: bool
    ) -> Runaway | None:
        """Process proven motion in a time window; return an uncommanded motion.

        Distance accumulates over consecutive windows. A window that is published again is ignored, and so is one that
        starts before the robot stands, because it shows braking.

        Args:
            since: start of the window (ns).
            stamp: end of the window (ns).
            moved: distance travelled by the body (m).
            config: limits.
            stood: time from which the robot must stand (ns).
            now: end of the extrapolation of the motion (ns).
            driven: whether a motor may be moving the robot.
        """
        if stamp == self._stamp:
            return None
        goes_on, self._stamp, self.runs = since == self._stamp, stamp, driven
        speed = moved / (stamp - since) * SECOND
        if not goes_on or not driven or since < stood:
            self._travel = 0.0
        if since < stood:
            return None
        self._travel += moved
        if not driven or self._travel + speed * (now - stamp) / SECOND <= config.distance:
            return None
        self._travel = 0.0
        return Runaway(RunawayKind.BODY_MOVES, self._source, speed, 0.0, 0.0)

    def expire(self, now: int) -> None:
        """Ignore the motion of a sample that is too old at ``now`` (ns)."""
        if self._stamp is not None and now - self._stamp > self._fresh_for:
            self.runs = False


class Escalation(IntEnum):
    """Steps against a runaway; each step follows if the previous one has not helped."""

    NONE = 0
    QUICK_STOP = 1
    """Quick stop in every exchange with the drive, deadman line low, emergency stop latched."""
    POWER_OFF = 2
    """Power stages off."""
    PORT_OFF = 3
    """Power of the drives' USB ports off, where configured."""


class RunawayCheck(Check):
    """Detects uncommanded motion of a motor in any mode; the finding stays until an operator resets the emergency stop.

    Every finding triggers the next step. The bounds then restart at the measured speed; if the step works, the shaft
    stays within them.

    Args:
        view: read access to the gate's state.
        config: limits.
    """

    reasons = (Reason.UNCOMMANDED_MOTION,)
    reads = (IMU, ENCODERS, CONSISTENCY, STABILISER)

    def __init__(self, view: GateView, config: RunawayConfig) -> None:
        super().__init__(view)
        self._config = config
        self._shafts = [ShaftWatch(topic.name.rpartition("/")[2]) for topic in DRIVES[: len(view.chassis.shafts)]]
        self._wheels = BodyWatch(DeviceRole.ENCODERS.value, ENCODERS.fresh_for())
        self._gyro = BodyWatch(DeviceRole.IMU.value, IMU.fresh_for())
        self._scans = BodyWatch(DeviceRole.LIDAR.value, SCAN.fresh_for())
        self._bodies = self._wheels, self._gyro, self._scans
        self._encoders: WheelEncoders | None = None
        self._unjudged: UnshownMotion | None = None
        """Proven motion of the body, kept until a motor current confirms it."""
        self._strays = 0
        """Strays counted by the joints of the lidar's mount."""
        self._commanded = 0
        """Time of the last motion command, ns."""
        self._halted = 0
        """Time since when every command has been a quick stop, ns."""
        self._step = Escalation.NONE
        self._found: Runaway | None = None
        self._found_at = 0
        """Time of the finding, ns."""
        self._count = 0

    # Inputs

    def observe(self, seen: Message | Tick, topic: Topic[Any] | None) -> None:
        """Process the command of a tick, or a measurement of motion."""
        match seen:
            case Tick():
                self._command(seen.now)
            case DriveFeedback() if topic is not None:
                self._take_drive(seen, DRIVES.index(topic))
            case WheelEncoders():
                self._take_encoders(seen)
            case Imu():
                rate = seen.angular_velocity
                turning = math.hypot(rate.x, rate.y, rate.z)
                self._take_body(self._gyro, seen, turning * self.view.footprint.half_width)
            case Consistency(unshown=UnshownMotion() as motion):
                self._take_unshown(motion, seen.received)
            case StabiliserFeedback():
                self._take_joints(seen)

    def _command(self, now: int) -> None:
        for body in self._bodies:
            body.expire(now)
        if self.view.mode.active:
            self._halted = now
        for watch, speed in zip(self._shafts, self.view.motion.shaft_speeds, strict=True):
            watch.bounds.order(now, speed)
            if speed:
                self._commanded = now

    def _take_drive(self, feedback: DriveFeedback, shaft: int) -> None:
        watch, limits = self._shafts[shaft], self.view.config
        watch.bounds.order(feedback.received, self.view.motion.shaft_speeds[shaft])
        metres = self.view.chassis.drivetrain.distance(1.0)
        found = watch.observe(feedback, metres, self._config, limits.reaction, limits.deceleration, limits.standstill)
        self._take(found, feedback.received)
        if self._unjudged is not None:
            self._take_unshown(self._unjudged, feedback.received)

    def _take_encoders(self, encoders: WheelEncoders) -> None:
        before, self._encoders = self._encoders, encoders
        if before is None or encoders.stamp <= before.stamp:
            return
        turned = max(abs(encoders.left - before.left), abs(encoders.right - before.right))
        rate = turned / ((encoders.stamp - before.stamp) / SECOND)
        self._take_body(self._wheels, encoders, rate * self.view.chassis.drivetrain.wheel_radius)

    @property
    def _obeyed(self) -> int:
        """Time by which every drive must have obeyed the latest order to stand (ns)."""
        limits = self.view.config
        return self._commanded + round((limits.reaction + limits.speed / limits.deceleration) * SECOND)

    @property
    def _stood(self) -> int:
        """Time from which motion of the body is judged (ns).

        Judging starts when all drives read standstill. Drives without a measured current get the full time to obey,
        because scans with late stamps may still show their braking.
        """
        still = [watch.still_since for watch in self._shafts if watch.measures_current]
        known = [since for since in still if since is not None]
        return max(self._commanded, *known) if len(known) == len(self._shafts) else self._obeyed

    def _take_body(self, watch: BodyWatch, seen: Message, speed: float) -> None:
        standstill, now = self.view.config.standstill, seen.received
        found = watch.observe(
            seen.stamp, speed, self._config, standstill, standing=now > self._stood, driven=self._pulled(now)
        )
        self._take(found, now)

    def _take_unshown(self, motion: UnshownMotion, now: int) -> None:
        """Judge proven motion of the body from the earliest time at which a motor could have caused it."""
        driven, powered = self._pulled(now), min(watch.powered_since for watch in self._shafts)
        if motion.stamp <= powered:
            self._unjudged = None
            return
        # The drive polls its current less often than its velocity: keep the motion until the next current decides.
        self._unjudged = None if driven or now - motion.stamp > SCAN.fresh_for() * SECOND else motion
        if self._unjudged is not None:
            return
        moved = max(motion.distance, abs(motion.turn) * self.view.footprint.half_width)
        found = self._scans.observe_window(
            motion.since,
            motion.stamp,
            moved,
            self._config,
            stood=max(self._stood, self._found_at, powered),
            now=now,
            driven=driven,
        )
        self._take(found, now)

    def _take_joints(self, seen: StabiliserFeedback) -> None:
        """Detect joints that move uncommanded: they already have no torque, so only the drives need to stop."""
        before, self._strays = self._strays, seen.pitch_joint.strays + seen.roll_joint.strays
        if self._strays > before:
            self._found = Runaway(RunawayKind.STRAYS, DeviceRole.STABILISER.value, 0.0, 0.0, 0.0)
            self._count += 1
            self._step = max(self._step, Escalation.QUICK_STOP)

    def _pulled(self, now: int) -> bool:
        """Return whether a motor may be moving the body; a body that falls or slides is moved by its weight."""
        samples = self.view.samples
        if samples.tips(now):
            return False
        fresh = bool(samples.shaft_speeds(now))
        return any(watch.pulls(self._config, fresh=fresh) for watch in self._shafts)

    def _take(self, found: Runaway | None, now: int) -> None:
        if found is None or self._step is Escalation.PORT_OFF:
            return
        self._found, self._found_at = found, now
        self._count += 1
        stopped = now - self._halted > self.view.config.reaction * SECOND
        # A drive that reads standstill while the body moves cannot confirm a quick stop either.
        blind = found.kind is RunawayKind.BODY_MOVES
        least = Escalation.POWER_OFF if stopped or blind else Escalation.QUICK_STOP
        self._step = Escalation(min(max(self._step + 1, least), Escalation.PORT_OFF))

    # Results

    def reason(self, now: int) -> Iterator[Reason]:
        """Report a finding that no operator has cleared."""
        if self._found is not None:
            yield Reason.UNCOMMANDED_MOTION

    @property
    def moves(self) -> bool:
        """Whether a motor turns a shaft or moves the body."""
        return any(watch.moves and watch.driven for watch in self._shafts) or self._body_moves

    @property
    def _body_moves(self) -> bool:
        return any(watch.runs for watch in self._bodies)

    @property
    def findings(self) -> int:
        """Number of findings so far."""
        return self._count

    @property
    def power_off(self) -> bool:
        """Whether quick stops have failed to stop the motion."""
        return self._step >= Escalation.POWER_OFF

    @property
    def port_off(self) -> bool:
        """Whether switching off the power stages has also failed."""
        return self._step >= Escalation.PORT_OFF

    def text(self, reason: Reason) -> str:
        """Return the motion, and the step taken against it."""
        found = self._found
        if found is None:
            return reason.text
        done = {
            Escalation.QUICK_STOP: "quick stop",
            Escalation.POWER_OFF: "quick stop has no effect: power stage off",
            Escalation.PORT_OFF: "no stop has an effect: switch the motors off by hand",
        }
        return f"{found.text}; {done[self._step]}"

    def figures(self, reason: Reason, now: int) -> Iterator[Measurement]:
        """Measured speed, with the speed allowed by the orders as its limit."""
        if (found := self._found) is not None and found.kind is not RunawayKind.STRAYS:
            limit = found.high if found.measured >= 0.0 else found.low
            yield Measurement(name="speed", value=found.measured, unit="m/s", limit=limit)

    def reset(self) -> None:
        """Clear the finding: the operator confirms that the cause is gone."""
        if self.view.mode is GateMode.ESTOPPED:
            self._found, self._step = None, Escalation.NONE
