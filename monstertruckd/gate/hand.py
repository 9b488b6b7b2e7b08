"""Radio control used by an operator next to the robot: the driving role with the highest priority.

- The arm switch of the transmitter is a key: while it is off, the robot does not drive, even if another operator has
  armed it. Switching it from off to on is the order to arm.
- While the arm switch and the drive switch (if fitted) are on, the sticks drive the robot.
- While the emergency stop switch is on, the robot stays emergency-stopped, even if another operator resets it.
- Loss of the transmitter stops and disarms the robot, whichever source drives. After reconnection, the arm switch must
  be turned off once before it can arm the robot.
"""

import secrets
from typing import Annotated, Any, Final, NamedTuple, Protocol

from pydantic import Field

from monstertruck_runtime.clock import SECOND, Clock, Schedule
from monstertruck_runtime.ports import EventSink, Ready, Subscription
from monstertruck_schemas import topics
from monstertruck_schemas.base import Schema
from monstertruck_schemas.event import Severity
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import ControlRequest, DriveRequest, Order, RequestedTwist, Role
from monstertruck_schemas.roles import DeviceRole, ServiceName
from monstertruck_schemas.sensor import HandControls
from monstertruck_schemas.state import GateMode, GateState
from monstertruck_schemas.topics import Topic

MOBILE: Final = frozenset({GateMode.ARMED, GateMode.DRIVING})
"""Modes that allow motion."""


class HandConfig(Schema):
    """Radio control used by an operator next to the robot (`devices.hand`)."""

    speed: Annotated[float, Field(gt=0, le=10)] = 0.2
    """Speed at full stick deflection, m/s"""
    angle: Annotated[float, Field(gt=0, le=0.8)] = 0.35
    """Front axle angle at full stick deflection, rad"""
    turn: Annotated[float, Field(gt=0, le=10)] = 1.0
    """Yaw rate at full stick deflection for a body without steered axles, rad/s"""
    lost_after: Annotated[float, Field(gt=0, le=1)] = 0.25
    """Age of the latest receiver message above which the radio control is lost, s"""
    quality: Annotated[float, Field(ge=0, le=1)] = 0.3
    """Fraction of received radio packets below which the radio control is lost"""


class HandActions(NamedTuple):
    """Actions derived from one reading of the radio control."""

    orders: tuple[Order, ...] = ()
    drives: bool = False
    """Whether the sticks request a motion or standstill."""
    lost: str | None = None
    """Why the radio control is lost; None if it is not."""


class HandPolicy:
    """Converts receiver messages to orders, without side effects.

    Args:
        config: limits.
    """

    def __init__(self, config: HandConfig) -> None:
        self._config = config
        self._seen_off = False
        """Whether the arm switch has been off since the loss of the transmitter, or since the last order to arm."""
        self._stopped_at: int | None = None

    def step(self, controls: HandControls | None, mode: GateMode | None, now: int) -> HandActions:
        """Return the actions for the latest receiver message.

        Args:
            controls: latest message from the receiver, if any.
            mode: mode of the gate, if known.
            now: current time (ns).
        """
        lost = self._lost(controls, now)
        if lost is not None or controls is None:
            self._seen_off = False
            return HandActions(self._stop(mode, now), lost=lost)
        orders = (Order.ESTOP,) if controls.estop and mode is not GateMode.ESTOPPED else ()
        if not controls.arm:
            self._seen_off = True
            return HandActions((*orders, *self._stop(mode, now)))
        self._stopped_at = None
        if self._seen_off and mode is GateMode.DISARMED and not controls.estop:
            orders = (*orders, Order.ARM)
        self._seen_off = False
        return HandActions(orders, drives=controls.drive and not controls.estop)

    def _lost(self, controls: HandControls | None, now: int) -> str | None:
        config = self._config
        if controls is None:
            return "no data from the receiver yet"
        if now - controls.received > config.lost_after * SECOND:
            return f"the receiver has been silent for more than {config.lost_after:g} s"
        if controls.lost:
            return "the receiver has lost the transmitter"
        if controls.link_quality is not None and controls.link_quality < config.quality:
            return f"link quality {controls.link_quality:.0%}: at least {config.quality:.0%} is needed"
        return None

    def _stop(self, mode: GateMode | None, now: int) -> tuple[Order, ...]:
        """Orders that bring a moving robot to rest; repeated until the robot is at rest."""
        repeat = SECOND // 5  # time between two orders to stop a robot that still moves, ns
        if mode not in MOBILE or (self._stopped_at is not None and now - self._stopped_at < repeat):
            return ()
        self._stopped_at = now
        return Order.STOP, Order.DISARM


class Inject(Protocol):
    """Injects a request; see ``Bus.inject``."""

    def __call__(self, topic: Topic[Any], message: Any) -> object:
        """See ``Bus.inject``."""


class HandService:
    """Drives the robot by radio control, and stops it when the radio control is lost.

    Args:
        config: limits.
        clock: time source.
        hand: latest message from the receiver.
        gate: latest state of the gate.
        inject: receives the requests.
        events: receives events: loss and return of the radio control.
        steered: whether the body has steered axles; without them the steering stick turns the body.
    """

    name = ServiceName.HAND_DRIVE.value

    def __init__(
        self,
        config: HandConfig,
        clock: Clock,
        hand: Subscription[HandControls],
        gate: Subscription[GateState],
        inject: Inject,
        events: EventSink,
        *,
        steered: bool,
    ) -> None:
        self._config = config
        self._clock = clock
        self._hand = hand
        self._gate = gate
        self._inject = inject
        self._events = events
        self._steered = steered
        self._policy = HandPolicy(config)
        self._instance = secrets.token_hex(8)
        self._seq = 0
        self._lost: str | None = ""
        """Reported reason of the loss; None if the radio control was reported as connected."""

    async def run(self, ready: Ready) -> None:
        """Convert receiver messages into requests until cancelled."""
        schedule = Schedule(self._clock, 20.0)  # requests per second
        while True:
            await schedule.next()
            now, gate, controls = self._clock.now(), self._gate.latest, self._hand.latest
            actions = self._policy.step(controls, None if gate is None else gate.mode, now)
            self._report(actions.lost)
            if gate is not None:
                self._send(actions, controls, gate, now)
            ready()

    def _send(self, actions: HandActions, controls: HandControls | None, gate: GateState, now: int) -> None:
        if actions.drives and controls is not None:
            # Send before an order to arm, so that the gate knows whether the stick is at rest.
            self._inject(topics.REQ_DRIVE, DriveRequest(**self._header(gate, now), **self._motion(controls)))
        for order in actions.orders:
            self._inject(topics.REQ_CONTROL, ControlRequest(**self._header(gate, now), order=order))

    def _motion(self, controls: HandControls) -> dict[str, Any]:
        config = self._config
        if self._steered:
            speed, front = controls.speed * config.speed, controls.steer * config.angle
            return {"speed": speed, "front": front, "unseen": controls.unseen}
        twist = RequestedTwist(vx=controls.speed * config.speed, wz=controls.steer * config.turn)
        return {"speed": 0.0, "front": 0.0, "twist": twist, "unseen": controls.unseen}

    def _header(self, gate: GateState, now: int) -> dict[str, Any]:
        self._seq += 1
        return {
            "stamp": now,
            "received": now,
            "seq": self._seq,
            "source": DeviceRole.HAND.value,
            "role": Role.HAND,
            "lease": 0.25,  # validity of a request, s
            "nonce": gate.nonce,
            "gate_stamp": gate.stamp,
            "instance": self._instance,
        }

    def _report(self, lost: str | None) -> None:
        """Report each loss and each return once."""
        if (lost is None) is (self._lost is None):
            return
        self._lost = lost
        if lost is None:
            self._events(Reason.DEVICE_READY, Severity.INFO, self.name, "the radio control is connected")
        else:
            self._events(Reason.DEVICE_LOST, Severity.WARNING, self.name, f"radio control lost: {lost}")
