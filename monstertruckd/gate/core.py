"""The safety gate as a pure state machine: requests and observations in, actuator commands out at every tick.

States: disarmed > armed > driving > stopping > (armed | disarmed); an emergency stop from any state latches.
A stop is a single command: speed 0 or quick stop. The drive controller runs the ramp, so the stop completes even if
nothing more is sent. ``arbitration`` selects the driver and holds the transitions, ``sensors`` holds checks that
stop or slow the truck, ``limiter`` converts requests to the commanded motion, ``stops`` reports the causes.

Every stop ends when the drive confirms standstill. After a short fault (a late scan, an expired lease) the same
source may continue; a fault longer than ``disarm_after``, or a reason in ``DISARMING``, disarms.
"""

import math
from collections import deque
from collections.abc import Generator, Iterator, Mapping, Sequence
from types import MappingProxyType
from typing import Any, Final, NamedTuple, assert_never

from monstertruck_kinematics.chassis import Chassis
from monstertruck_kinematics.elementary import KinematicsError
from monstertruck_planners.behave.dock.config import DockConfig
from monstertruck_planners.collision import Footprint, ScanPoints
from monstertruck_planners.zones.config import ZonesConfig
from monstertruck_runtime.clock import SECOND
from monstertruck_runtime.requests import OPERATORS, late_text
from monstertruck_runtime.stop_text import causes_text
from monstertruck_schemas.base import Message
from monstertruck_schemas.cmd import DriveAction
from monstertruck_schemas.event import Cause, Severity, Stop
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import ControlRequest, DriveForm, DriveRequest, Order, Role
from monstertruck_schemas.state import GateMode
from monstertruck_schemas.topics import BATTERY, COMPASS, DRIVES, SCANS, STEERING, Topic
from monstertruckd.gate.arbitration import EventLog, GateEvent, GateStateMachine, Source, Sources
from monstertruckd.gate.assist import Assist
from monstertruckd.gate.catalog import CheckConfig
from monstertruckd.gate.checks import Check, Checks, GateView, Tick
from monstertruckd.gate.config import GateConfig, InForce
from monstertruckd.gate.consistency import ConsistencyCheck
from monstertruckd.gate.contact import ContactCheck
from monstertruckd.gate.docking import DockCheck
from monstertruckd.gate.following import ShaftCheck, SteeringCheck
from monstertruckd.gate.limiter import CommandLimiter
from monstertruckd.gate.motion import Motion
from monstertruckd.gate.obstacles import ObstacleCheck
from monstertruckd.gate.own_checks import OwnCheck
from monstertruckd.gate.peers import PeerCheck
from monstertruckd.gate.runaway import RunawayCheck
from monstertruckd.gate.samples import STALE_SENSORS, Samples
from monstertruckd.gate.scan_memory import GroundSurvey
from monstertruckd.gate.sensors import (
    DRIVE_LOSSES,
    BatteryCheck,
    DriveFaultCheck,
    ServiceCheck,
    StalenessCheck,
    TickCheck,
    TiltCheck,
)
from monstertruckd.gate.sonars import Place, SonarCheck
from monstertruckd.gate.stops import Outages, StopLog, lease_cause
from monstertruckd.gate.zones import ZoneCheck

URGENT: Final = frozenset(
    {Reason.DRIVE_STALE, Reason.DRIVE_FAULT, Reason.TICK_STALLED, Reason.SERVICE_FAILED, Reason.SHUTDOWN}
)
"""Reasons that stop by quick stop, which overtakes queued commands; other reasons stop by the drive's ordinary ramp."""

DISARMING: Final = frozenset(
    {
        Reason.DRIVE_FAULT,
        *DRIVE_LOSSES,
        Reason.BATTERY_CRITICAL,
        Reason.SERVICE_FAILED,
        Reason.STEERING_DEAD,
        Reason.SHAFT_BLOCKED,
        Reason.SENSORS_DISAGREE,
    }
)
"""Reasons that disarm the truck even if they are short."""

HALTS: Final = frozenset(
    {
        Reason.OBSTACLE_STOP,
        Reason.UNSEEN_STOP,
        Reason.CONTACT,
        Reason.KEEPOUT,
        Reason.LIDAR_BLIND,
        Reason.SONAR_STALE,
        Reason.SONAR_BLIND,
        Reason.OWN_CHECK,
    }
)
"""Speed limits of zero: the truck stands while its driver stays in control."""


def sensor_checks(view: GateView, *, battery_measured: bool, compared: bool = False) -> Iterator[Check]:
    """Checks that do not depend on where the robot drives, worst reasons first.

    Args:
        view: read access to the gate's state.
        battery_measured: whether a device measures the battery.
        compared: whether the robot has to compare its measurements of motion.
    """
    config = view.config
    if config.runaway is not None:
        yield RunawayCheck(view, config.runaway)
    yield TickCheck(view)
    if config.turning is not None:
        yield SteeringCheck(view, config.turning)
    if config.blocked is not None:
        yield ShaftCheck(view, config.blocked)
    yield DriveFaultCheck(view)
    yield ServiceCheck(view)
    yield StalenessCheck(view)
    if compared:
        yield ConsistencyCheck(view)
    yield TiltCheck(view)
    yield BatteryCheck(view, measured=battery_measured)


def obstacle_checks(
    view: GateView,
    points: Sequence[ScanPoints],
    sonars: Mapping[str, Place] | None,
    rear_sonars: Mapping[str, Place] | None,
    peers: Mapping[str, Footprint] | None,
) -> Iterator[Check]:
    """Checks of the path ahead; for the arguments see ``Gate``."""
    lidar = None if sonars else ObstacleCheck(view, points, rear_sonars)
    sonar = SonarCheck(view, sonars) if sonars else None
    yield from (check for check in (lidar, sonar) if check is not None)
    if lidar is not None:
        yield Assist(view, lidar.guard)
    if peers:
        yield PeerCheck(view, peers, None if lidar is None else lidar.guard, None if sonar is None else sonar.guard)


class Decision(NamedTuple):
    """The gate's decision on an order."""

    reason: Reason
    """OK, or the reason for the refusal."""
    text: str


ACCEPTED: Final = Decision(Reason.OK, Reason.OK.text)


class GateOutput(NamedTuple):
    """Result of one tick: fields of DriveCommand, SteeringCommand and GateState, events and stops."""

    action: DriveAction
    speeds: tuple[float, ...]
    """Wheel speed over ground of every driven shaft, m/s."""
    motor_velocities: tuple[float, ...]
    """Motor rate of every driven shaft, as in ``DriveCommand``."""
    front: float
    """Front axle angle, rad."""
    rear: float
    """Rear axle angle, rad."""
    servos: tuple[float, ...]
    """Servo angles, rad: front and rear, or front left, front right, rear left and rear right."""
    form: DriveForm | None
    """Form of the holder's latest request."""
    twist: tuple[float, float, float]
    """Commanded twist of the base, m/s, m/s, rad/s."""
    mode: GateMode
    holder: str | None
    role: Role | None
    lease_left: float | None
    """Remaining lease of the holder, s."""
    last_seq: int | None
    speed_limit: float
    """Speed limit in force, m/s."""
    reasons: tuple[Reason, ...]
    stopping_distance: float
    """Distance travelled if stopped now, m."""
    waiting: tuple[str, ...]
    """Planners that request motion while no source drives."""
    asking: tuple[str, ...]
    """Operators who ask for the drive."""
    handed_to: str | None
    """Operator who has just received the drive."""
    events: tuple[GateEvent, ...]
    trips: tuple[Stop, ...]
    stopping: bool
    """Whether the truck must stand and its standstill is not measured yet."""
    port_off: bool
    """Whether only switching off the drives' ports stops the truck."""


class Gate:
    """The safety gate, without input or output.

    Args:
        config: limits.
        chassis: kinematics of the body, its motors and servos.
        footprint: the truck's outline.
        points: converts the scans of every lidar to points in the base frame.
        services: reason reported when a sensor service is lost, by service name.
        nonce: nonce of this run; requests must carry it.
        battery_measured: whether a device measures the battery.
        latched: whether the emergency stop was latched when the daemon last ran.
        sonars: sonars of a robot without a lidar: pose in the base frame (x and y in m, yaw in rad), by name.
        rear_sonars: rear-facing sonars of a robot with a lidar, in the same form as ``sonars``.
        peers: outlines of other robots whose poses are received, by name.
        compared: whether the robot has to compare its measurements of motion.
        zones: settings of the zones; None without zones.
        docks: docks by name.
        own: settings of checks added by the configuration, by name.
    """

    def __init__(
        self,
        config: GateConfig,
        *,
        chassis: Chassis,
        footprint: Footprint,
        points: Sequence[ScanPoints],
        services: Mapping[str, Reason],
        nonce: str,
        battery_measured: bool,
        latched: bool,
        sonars: Mapping[str, Place] | None = None,
        rear_sonars: Mapping[str, Place] | None = None,
        peers: Mapping[str, Footprint] | None = None,
        compared: bool = False,
        zones: ZonesConfig | None = None,
        docks: Mapping[str, DockConfig] = MappingProxyType({}),
        own: Mapping[str, CheckConfig] = MappingProxyType({}),
    ) -> None:
        self._limits = InForce(config)
        self._chassis = chassis
        self._sources = Sources(nonce, config)
        self._events = EventLog(config.event_interval)
        self._states = GateStateMachine(self._events, latched=latched)
        self._samples = Samples(self._limits, chassis, services, len(points))
        self._motion = Motion(self._limits, chassis)
        view = GateView(self._limits, chassis, footprint, self._samples, self._motion, self._states)
        self._limiter = CommandLimiter(view)
        self._contact = None if config.contact is None else ContactCheck(view, config.contact)
        self._checks = Checks(
            (
                *sensor_checks(view, battery_measured=battery_measured, compared=compared),
                self._limiter,
                *(() if self._contact is None else (self._contact,)),
                *((DockCheck(view, docks),) if docks else ()),
                *obstacle_checks(view, points, sonars, rear_sonars, peers),
                *(() if zones is None else (ZoneCheck(zones, view),)),
                *(OwnCheck(view, name, settings) for name, settings in own.items()),
            )
        )
        self._obstacles = next((check for check in self._checks if isinstance(check, ObstacleCheck)), None)
        self._assist = next((check for check in self._checks if isinstance(check, Assist)), None)
        self._outages = Outages(services)
        self._stops = StopLog(self._outages)
        self._known: dict[Reason, int] = {}
        """Reasons that stop or slow the truck, with their start (ns)."""
        self._short_faults: deque[int] = deque()
        """Times of stops for stale sensors since the truck was armed, ns."""
        self._ticked: int | None = None
        self._shut_down = False
        self._findings = 0
        """Number of findings already handled."""
        self._unconfirmed = False
        """Whether the truck may have moved since the last measured standstill."""

    def configure(self, config: GateConfig) -> None:
        """Replace the limits between two ticks; changed settings take effect immediately only if they are marked live.

        If a limit is lowered, a driving truck slows down along its ramp.
        """
        self._limits.config = config

    def _at_rest(self, now: int, since: int = 0) -> bool:
        """Return whether every check, and a sample not older than ``since`` (ns), show that the truck is at rest."""
        return self._samples.at_rest(now, since) and not self._checks.moves

    @property
    def _config(self) -> GateConfig:
        return self._limits.config

    @property
    def mode(self) -> GateMode:
        """Current mode."""
        return self._states.mode

    @property
    def nonce(self) -> str:
        """Nonce of this run."""
        return self._sources.nonce

    @property
    def reads(self) -> tuple[Topic[Any], ...]:
        """Topics whose latest message the gate must observe before every tick, in this order."""
        scans, drives = SCANS[: len(self._samples.scans)], DRIVES[: len(self._chassis.shafts)]
        return tuple(dict.fromkeys((*scans, COMPASS, *drives, STEERING, BATTERY, *self._checks.reads)))

    def survey(self) -> Generator[None, None, GroundSurvey | None] | None:
        """Map the ground seen by the lidar, in short steps; None if no lidar guards the robot."""
        return None if self._obstacles is None else self._obstacles.guard.memory.survey()

    def observe(self, message: Message, topic: Topic[Any]) -> None:
        """Process the latest message of a topic, and every health table, because a later table may hide a restart.

        Args:
            message: message from a sensor or from other robots, a health table, or an event from any service.
            topic: topic of the message.
        """
        self._samples.observe(message, topic)
        self._checks.observe(message, topic)
        self._outages.observe(message)

    # Requests

    def request(self, request: DriveRequest, now: int) -> Reason:
        """Process an external drive request; return OK, or why it does not move the truck."""
        return self._consider(request, now, self._sources.accept_request(request, now), inside=False)

    def planner_request(self, request: DriveRequest, now: int) -> Reason:
        """Process a drive request from the robot's planners; return the same values as ``request``."""
        return self._consider(request, now, self._sources.accept_planner_request(request, now), inside=True)

    def _consider(self, request: DriveRequest, now: int, accepted: Reason, *, inside: bool) -> Reason:
        if accepted is not Reason.OK:
            return self._refuse(now, accepted, request)
        wrong = {name: value for name, value in request.numbers.items() if not math.isfinite(value)}
        if wrong:
            text = ", ".join(f"{name} is {value}" for name, value in wrong.items()) + ": expected finite numbers"
            return self._refuse(now, Reason.NOT_FINITE, request, text)
        if (why := self._impossible(request)) is not None:
            return self._refuse(now, Reason.IMPOSSIBLE_MOTION, request, why)
        if request.form is DriveForm.SHAFTS and (inside or request.role not in OPERATORS):
            text = "a request by shaft speeds: open loop is for operators, not for planners and trackers"
            return self._refuse(now, Reason.BAD_ROLE, request, text)
        source = self._sources.add(request, now, inside=inside)
        if self.mode is GateMode.ESTOPPED:
            return self._refuse(now, Reason.ESTOPPED, request)
        if self.mode is GateMode.DISARMED:
            return self._refuse(now, Reason.DISARMED, request)
        reason = self._sources.priority(source, now, self._states.holder_key)
        if reason is Reason.BUSY and inside and source.neutral:
            return reason  # It drives when the driving planner ends.
        if reason is not Reason.OK:
            return self._refuse(now, reason, request)
        return next(iter(self._blocks(now)), Reason.OK)

    def _impossible(self, request: DriveRequest) -> str | None:
        """Return why the body cannot perform this motion; None if it can perform it or a similar motion."""
        forms = self._chassis.forms
        if request.form not in forms:
            return f"a request by {request.form}: this body accepts {' or '.join(sorted(forms))}"
        try:
            self._motion.target(request)
        except KinematicsError as error:
            return str(error)
        return None

    def control(self, request: ControlRequest, now: int) -> Decision:
        """Carry out or refuse an order.

        ESTOP and STOP are accepted from every source admitted by the bus, authenticated or not: stopping is always
        safe. ARM and RESET require an operator's role, a truck at rest and no operator requesting motion. An
        authenticated ESTOP or STOP consumes its sequence number, so the gate refuses an earlier order from the same
        source that arrives later over another channel. The gate also refuses an ARM or RESET if its sender did not yet
        know of an ESTOP, STOP or DISARM by another source.
        """
        reason, order = self._sources.accept_order(request, now), request.order
        if order is Order.ESTOP or order is Order.STOP:
            # An order sent by topic and by call arrives twice; the second copy has a used number.
            authenticated = reason in (Reason.OK, Reason.BAD_SEQUENCE)
            self._sources.stopped(request.source if authenticated else "", now)
            return self._estop(request, now) if order is Order.ESTOP else self._stop_by(request, now)
        if reason is not Reason.OK:
            return self._refuse_order(now, reason, request)
        if stopped_by := self._sources.overtaken(request):
            text = f"{stopped_by} has ordered a stop in the meantime"
            return self._refuse_order(now, Reason.BAD_SEQUENCE, request, text)
        if order is Order.DISARM:
            return self._disarm_by(request, now)
        if request.role not in OPERATORS:
            return self._refuse_order(now, Reason.BAD_ROLE, request)
        match order:
            case Order.ASK:
                return self._ask(request, now)
            case Order.HAND_OVER:
                return self._hand_over(request, now)
            case Order.ARM:
                return self._arm(request, now)
            case Order.RESET:
                return self._reset(request, now)
            case _:
                assert_never(order)

    def _refuse(self, now: int, reason: Reason, request: DriveRequest | ControlRequest, text: str = "") -> Reason:
        what = request.order.value if isinstance(request, ControlRequest) else "drive"
        text = text or self._worded(reason)
        values = {"role": request.role.value, "request": what}
        lasting = reason is Reason.LOWER_PRIORITY  # a tracker keeps asking while an operator drives
        self._events.emit(now, reason, Severity.WARNING, text, values, source=request.source, lasting=lasting)
        return reason

    def _refuse_order(self, now: int, reason: Reason, request: ControlRequest, text: str = "") -> Decision:
        text = text or self._worded(reason)
        return Decision(self._refuse(now, reason, request, text), text)

    def _worded(self, reason: Reason) -> str:
        """Text of a refusal; a late request is reported as late, not as an expired lease."""
        return late_text(self._config.max_request_age) if reason is Reason.LEASE_EXPIRED else reason.text

    def _refuse_blocked(self, now: int, blocks: tuple[Reason, ...], request: ControlRequest) -> Decision:
        causes = self._outages.explain(self._checks.describe(blocks, now, self._known))
        return self._refuse_order(now, blocks[0], request, causes_text(causes, now))

    def _refuse_moving(self, now: int, request: ControlRequest) -> Decision | None:
        """Return a refusal while the robot may move or an operator requests motion; None otherwise."""
        if not self._at_rest(now):
            speed = self._samples.speed(now)
            if speed is None:
                return self._refuse_blocked(now, (Reason.DRIVE_STALE,), request)
            if self._samples.at_rest(now):
                text = "the drive reports standstill, but the robot moves"
                return self._refuse_order(now, Reason.UNCOMMANDED_MOTION, request, text)
            return self._refuse_order(now, Reason.NOT_ARMED_SPEED, request, f"the robot moves at {speed:.2f} m/s")
        if sources := self._sources.requesting_motion(now):
            text = f"motion is requested by {', '.join(sources)}: expected a neutral stick"
            return self._refuse_order(now, Reason.NOT_ARMED_SPEED, request, text)
        return None

    def _estop(self, request: ControlRequest, now: int) -> Decision:
        if self.mode is not GateMode.ESTOPPED:
            why = _order_cause(Reason.ESTOP_REQUESTED, f"emergency stop by {request.source}", request, now)
            self._trip(now, GateMode.ESTOPPED, [why])
            self._states.latch(now)
            values = {"role": request.role.value}
            self._events.emit(
                now, Reason.ESTOP_REQUESTED, Severity.ERROR, "", values, source=request.source, always=True
            )
        return ACCEPTED

    def _stop_by(self, request: ControlRequest, now: int) -> Decision:
        if request.role is not Role.TRACKER:
            self._sources.claim(request.role)
        self._sources.hold(now)
        if self.mode is GateMode.DRIVING:
            text = f"stop ordered by {request.source}"
            self._stop(now, [_order_cause(Reason.STOPPED, text, request, now)], ordered=True)
            self._emit_transition(now, Reason.STOPPED, text)
        return ACCEPTED

    def _disarm_by(self, request: ControlRequest, now: int) -> Decision:
        self._sources.stopped(request.source, now)
        text = f"disarmed by {request.source}"
        if self.mode is GateMode.ARMED:
            self._disarm(now, text)
        else:
            self._states.disarm_at_rest = True
            if self.mode is GateMode.DRIVING:
                self._stop(now, [_order_cause(Reason.DISARMED, text, request, now)], ordered=True)
                self._emit_transition(now, Reason.DISARMED, text)
        return ACCEPTED

    def _arm(self, request: ControlRequest, now: int) -> Decision:
        if self.mode is GateMode.ESTOPPED:
            return self._refuse_order(now, Reason.ESTOPPED, request, self._stops.summary(now))
        if blocks := self._blocks(now):
            return self._refuse_blocked(now, blocks, request)
        if self.mode is GateMode.STOPPING:
            return self._refuse_order(now, Reason.NOT_ARMED_SPEED, request, "the robot is still stopping")
        if refusal := self._refuse_moving(now, request):
            return refusal
        self._sources.release(planners=not request.hold)
        self._states.arm(now, request.source, calibrates=request.calibrates)
        return ACCEPTED

    def _ask(self, request: ControlRequest, now: int) -> Decision:
        holder = self._states.holder
        if holder is None or holder.inside:
            return self._refuse_order(now, Reason.NOT_FOUND, request, "no operator is driving who could hand over")
        if holder.request.source == request.source:
            return self._refuse_order(now, Reason.BUSY, request, f"{request.source} already drives")
        self._sources.ask(request.source, now)
        text = f"{request.source} requests control from {holder.request.source}"
        self._events.emit(now, Reason.DRIVE_ASKED, Severity.INFO, text, source=request.source)
        return ACCEPTED

    def _hand_over(self, request: ControlRequest, now: int) -> Decision:
        holder = self._states.holder
        if holder is None or holder.inside or holder.request.source != request.source:
            return self._refuse_order(now, Reason.BAD_ROLE, request, "only the driving operator can hand over")
        asking = self._sources.asking(now)
        if request.to not in asking or request.to is None:
            text = f"to {request.to}: expected an operator who requested control: {', '.join(asking) or 'none did'}"
            return self._refuse_order(now, Reason.BAD_INPUT, request, text)
        text = f"{request.source} hands over to {request.to}"
        self._sources.hand_over(holder, request.to, now)
        self._events.emit(now, Reason.DRIVE_HANDED, Severity.INFO, text, source=request.source, always=True)
        if not self._sources.live_name(request.to, now):
            self._stop(now, [_order_cause(Reason.DRIVE_HANDED, text, request, now)], ordered=True)
        return ACCEPTED

    def _reset(self, request: ControlRequest, now: int) -> Decision:
        if self.mode is not GateMode.ESTOPPED:
            return ACCEPTED
        if refusal := self._refuse_moving(now, request):
            return refusal
        self._disarm(now, f"emergency stop reset by {request.source}")
        return ACCEPTED

    # Ticks

    def tick(self, now: int) -> GateOutput:
        """Advance to ``now`` (ns) and compute the actuator commands."""
        period = SECOND / self._config.rate
        elapsed = period if self._ticked is None else now - self._ticked
        self._ticked = now
        dt = min(elapsed, 2 * period) / SECOND

        self._checks.observe(Tick(now, elapsed), None)
        blocks = self._blocks(now)
        self._report(now, blocks, always=self.mode is GateMode.DRIVING)
        self._stop_runaway(now)
        self._advance(now, blocks)
        self._confirm(now)
        holder = self._states.holder
        request = None if holder is None else holder.request
        if request is not None and self._contact is not None:
            request = self._contact.instead(request, now)
        if self._assist is not None:
            assisted = self._config.assist.on and self._by_hand(holder)
            request = self._assist.instead(request if assisted else None, now) or request
        courses = self._limiter.aim(now, dt, request)
        limits = self._checks.limits(now, courses)
        self._limiter.advance(dt, limits)
        if holder is not None:
            halts = [reason for reason in limits if reason in HALTS and reason not in self._known]
            if halts and not self._at_rest(now):
                self._trip(now, self.mode, self._checks.describe(halts, now, {}))
        self._report(now, tuple(limits), always=False)
        self._known = {reason: self._known.get(reason, now) for reason in (*blocks, *limits)}
        return self._output(now, blocks, limits)

    def _by_hand(self, holder: Source | None) -> bool:
        """Return whether an operator drives, rather than a calibration wizard."""
        if holder is None or holder.inside or self._states.calibrates:
            return False
        return holder.request.role in OPERATORS

    def _stop_runaway(self, now: int) -> None:
        """Latch the emergency stop for uncommanded motion; report every finding, even if already latched."""
        if self._checks.findings == self._findings:
            return
        self._findings = self._checks.findings
        causes = self._checks.describe([Reason.UNCOMMANDED_MOTION], now, self._known)
        self._trip(now, GateMode.ESTOPPED, causes)
        if self.mode is not GateMode.ESTOPPED:
            self._states.latch(now)
        self._motion.halt()
        text = self._checks.text(Reason.UNCOMMANDED_MOTION)
        values = {**self._samples.values(now), **{figure.name: figure.value for figure in causes[0].measurements}}
        self._events.emit(now, Reason.UNCOMMANDED_MOTION, Severity.ERROR, text, values, always=True)

    def _confirm(self, now: int) -> None:
        """Record that the truck moves or may move until its standstill is measured."""
        if self.mode.accepts_motion or self._checks.moves:
            self._unconfirmed = True
        elif self._at_rest(now, self._states.since):
            self._unconfirmed = False

    def _is_stopping(self, now: int) -> bool:
        """Return whether the truck must stand and its standstill has not yet been measured."""
        if self.mode.accepts_motion:
            return self.mode is GateMode.ARMED and not self._at_rest(now)
        return self._unconfirmed

    def neutral(self, now: int) -> GateOutput:
        """Return the last output before the daemon ends: a quick stop. The gate does not drive afterwards."""
        self._shut_down = True
        self._motion.halt()
        if self._states.active:
            if self.mode is GateMode.DRIVING or not self._at_rest(now):
                self._trip(now, GateMode.DISARMED, self._checks.describe([Reason.SHUTDOWN], now, {}))
            self._disarm(now, Reason.SHUTDOWN.text)
        return self._output(now, (Reason.SHUTDOWN,), {})

    def _blocks(self, now: int) -> tuple[Reason, ...]:
        """Reasons why the truck may not move, worst first."""
        return (*((Reason.SHUTDOWN,) if self._shut_down else ()), *self._checks.blocks(now))

    def _advance(self, now: int, blocks: tuple[Reason, ...]) -> None:
        """Perform at most one transition per tick."""
        states = self._states
        if not states.active:
            return
        states.disarm_at_rest |= not DISARMING.isdisjoint(blocks)
        driver = None if blocks else self._sources.driver(now, states.holder_key)
        if states.mode is GateMode.STOPPING and self._at_rest(now, states.since):
            states.rest(now)
        elif states.mode is GateMode.ARMED and states.disarm_at_rest:
            self._disarm(now, ", ".join(reason.text for reason in blocks))
        elif states.mode is not GateMode.STOPPING and driver is not None:
            if driver.key != states.holder_key or not driver.neutral:  # an ARM order may have ended its claim
                self._sources.claim(driver.request.role)
            states.drive(now, driver)
        elif states.holder is not None and not blocks and self._released(states.holder, now):
            states.release(now)
        elif states.holder is not None:
            if not blocks:
                self._emit_transition(now, Reason.LEASE_EXPIRED, f"no fresh request from {states.holder_name}")
            lapsed = [lease_cause(states.holder, now)]
            self._stop(now, self._checks.describe(blocks, now, self._known) or lapsed)
        elif now - states.driven > self._config.disarm_after * SECOND:
            self._disarm(now, f"no driver for {self._config.disarm_after:g} s")

    def _released(self, holder: Source, now: int) -> bool:
        """Return whether the holder last requested standstill and the truck has been at rest since."""
        return holder.neutral and self._motion.standing and self._at_rest(now, holder.arrived)

    def _stop(self, now: int, causes: list[Cause], *, ordered: bool = False) -> None:
        if not STALE_SENSORS.keys().isdisjoint(cause.reason for cause in causes):
            self._count_short_fault(now)
        self._trip(now, GateMode.STOPPING, causes, ordered=ordered)
        self._states.stop(now, (cause.reason for cause in causes))

    def _count_short_fault(self, now: int) -> None:
        """Count a short fault; the driver may continue, but too many faults disarm the truck at rest."""
        faults, config = self._short_faults, self._config
        faults.append(now)
        while now - faults[0] > config.short_faults_within * SECOND:
            faults.popleft()
        if len(faults) >= config.short_faults:
            text = f"{len(faults)} stops for stale sensors within {config.short_faults_within:g} s: disarmed"
            self._emit_transition(now, Reason.FAULTS_REPEAT, text)
            self._states.disarm_at_rest = True

    def _trip(self, now: int, mode: GateMode, causes: list[Cause], *, ordered: bool = False) -> None:
        """Log a stop; must be called before the state changes."""
        holder = self._states.holder
        reasons = tuple(cause.reason for cause in causes)
        self._stops.add(
            now,
            mode,
            causes,
            ordered=ordered,
            quick=mode is GateMode.ESTOPPED or self._checks.urgent or not URGENT.isdisjoint(reasons),
            driver=None if holder is None else holder.request,
            speed=self._samples.speed(now),
            stopping_distance=self._limiter.stopping_distance(now),
        )

    def _emit_transition(self, now: int, reason: Reason, text: str) -> None:
        self._events.emit(now, reason, Severity.WARNING, text, always=True)

    def _disarm(self, now: int, text: str) -> None:
        self._checks.reset()
        self._short_faults.clear()
        self._states.disarm(now, text)

    def _report(self, now: int, reasons: tuple[Reason, ...], *, always: bool) -> None:
        """Emit an event for each reason that did not apply at the last tick."""
        if not self._states.active:
            return
        for reason in reasons:
            if reason not in self._known:
                text, values = self._checks.text(reason), self._samples.values(now)
                self._events.emit(now, reason, Severity.WARNING, text, values, always=always)

    def _action(self, now: int, reasons: tuple[Reason, ...]) -> DriveAction:
        if self._checks.power_off:
            return DriveAction.DISABLE
        if self.mode is GateMode.ESTOPPED or self._checks.urgent or not URGENT.isdisjoint(reasons):
            return DriveAction.QUICK_STOP
        if self.mode is GateMode.DISARMED:
            # A motor that still turns, for example after a crash of the daemon, must not coast.
            return DriveAction.DISABLE if self._at_rest(now) else DriveAction.QUICK_STOP
        return DriveAction.RUN

    def _output(self, now: int, blocks: tuple[Reason, ...], limits: dict[Reason, float]) -> GateOutput:
        slow = sorted(limits, key=limits.__getitem__)
        reasons = tuple(dict.fromkeys((*self._states.reasons, *blocks, *slow)))
        moving_allowed = self.mode.accepts_motion and not blocks
        motion, holder = self._motion, self._states.holder
        front, rear = motion.axle_angles
        return GateOutput(
            action=self._action(now, reasons),
            speeds=motion.shaft_speeds,
            motor_velocities=motion.motor_velocities,
            front=front,
            rear=rear,
            servos=motion.servos,
            form=None if holder is None else holder.request.form,
            twist=motion.twist,
            mode=self.mode,
            holder=self._states.holder_name,
            role=None if holder is None else holder.request.role,
            lease_left=None if holder is None else (holder.deadline - now) / SECOND,
            last_seq=None if holder is None else holder.request.seq,
            speed_limit=min(limits.values(), default=self._config.speed) if moving_allowed else 0.0,
            reasons=reasons,
            stopping_distance=self._limiter.stopping_distance(now),
            waiting=self._sources.waiting(now) if holder is None else (),
            asking=self._sources.asking(now),
            handed_to=self._sources.handed_to(now),
            events=self._events.drain(),
            trips=self._stops.drain(now, (*blocks, *limits)),
            stopping=self._is_stopping(now),
            port_off=self._checks.port_off,
        )


def _order_cause(reason: Reason, text: str, request: ControlRequest, now: int) -> Cause:
    """Cause of a stop that was ordered."""
    return Cause(reason=reason, source=request.source, since=now, text=text)
