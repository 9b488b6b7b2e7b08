"""Drills: a scripted fault on the whole daemon while it drives, and what really happened, measured.

Times come from three witnesses that know nothing of each other: the bytes on the drive controller's wire, the world's
truth, and the messages on the bus.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any, Final, cast

from monstertruck_runtime.mailbox import latest
from monstertruck_schemas import topics
from monstertruck_schemas.base import Message
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import DriveRequest, Role
from monstertruck_schemas.topics import Topic
from monstertruckd.tools.simulation.rig import VirtualRig

AT_REST: Final = 0.01
"""True speed of a truck that stands, m/s."""
SENSORS: Final[Mapping[str, Topic[Any]]] = {
    "lidar": topics.SCAN,
    "compass": topics.COMPASS,
    "drive": topics.DRIVE,
    "steering": topics.STEERING,
}


class Station:
    """A station that drives by requests, several a second, until told to be silent."""

    def __init__(self, rig: VirtualRig, speed: float = 0.18) -> None:
        self.silent = True
        self.speed = speed
        self._rig = rig
        self._seq = 0
        self._gate = rig.bus.subscribe(topics.GATE, latest())

    async def run(self) -> None:
        """Send until cancelled."""
        while True:
            if not self.silent:
                self.send(self.speed)
            await self._rig.clock.sleep(0.05)

    def send(self, speed: float) -> None:
        """Send one request."""
        now = self._rig.clock.now()
        self._seq += 1
        gate = self._gate.latest
        request = DriveRequest(
            stamp=now,
            received=now,
            seq=self._seq,
            source="station",
            role=Role.STATION,
            lease=0.25,
            nonce=gate.nonce if gate is not None else "",
            gate_stamp=gate.stamp if gate is not None else None,
            speed=speed,
            front=0.0,
        )
        self._rig.bus.inject(topics.REQ_DRIVE, request)


@dataclass(frozen=True, slots=True)
class Stage:
    """What a fault may lay hands on."""

    rig: VirtualRig
    station: Station

    def command(self, role: str, words: str) -> None:
        """A word for the fault console of one device."""
        self.rig.device(role).command(words.split())

    def swap_cables(self, one: str, other: str) -> None:
        """Pull two cables and plug each into the other's port."""
        ports = self.rig.ports
        for role in (one, other):
            ports[role].unplug()
        ports[one].device, ports[other].device = ports[other].device, ports[one].device
        for role in (one, other):
            ports[role].plug()

    def poison(self, topic: Topic[Any]) -> None:
        """What a bug looks like to a reader of ``topic``: a message it cannot understand."""
        self.rig.bus.hand_over(topic, cast("Message", object()))


class Expect(StrEnum):
    """What a fault may lead to."""

    STOP = "stop"
    """The daemon stops the truck, in time."""
    STOP_AHEAD = "stop ahead"
    """It stops as it should before it gets there; there is nothing that must be quick."""
    STOP_AGAIN = "stop again"
    """Nobody can reach the motor; it stops soon after somebody can."""
    STOP_BY_LINE = "stop by line"
    """Nobody can reach the motor; the deadman line stops it."""
    GO_ON = "go on"
    """Driving does not suffer."""
    ENDURE = "endure"
    """Driving may go on; if not, it ends in time."""
    SLOW_DOWN = "slow down"
    """The daemon limits the speed."""
    REFUSE = "refuse"
    """The truck stood, and cannot be made to move."""
    EXIT = "exit"
    """The daemon ends itself, neutral first."""


def _nothing(_: Stage) -> None:
    return None


@dataclass(frozen=True, slots=True)
class Scenario:
    """One fault.

    Args:
        name: for the table.
        inject: makes it.
        expect: what has to happen.
        heal: takes it away.
        seen: reasons that the gate's state or events must name, in this order; the last is the one that stops.
        down: services that must be reported lost, and why.
        lead: seconds until somebody tries to drive, where the truck stands at first.
        device: the role whose samples it spoils.
        hold: seconds it lasts.
        recovers: afterwards the truck can be driven again.
        resumes: the truck goes on by itself afterwards, by the gate's rule for short trouble.
        by_station: a station drives, not the tracker.
        overlay: configuration it needs, laid over the drill's own.
        patience: seconds the way back to normal may take; a replugged device: 2 s.
    """

    name: str
    inject: Callable[[Stage], None]
    expect: Expect
    heal: Callable[[Stage], None] = _nothing
    seen: tuple[Reason, ...] = ()
    down: Mapping[str, Reason] = field(default_factory=dict)
    device: str | None = None
    lead: float = 0.0
    hold: float = 2.5
    recovers: bool = True
    resumes: bool = False
    by_station: bool = False
    overlay: Mapping[str, Any] = field(default_factory=dict)
    patience: float = 2.0


@dataclass(frozen=True, slots=True)
class Reaction:
    """What happened; seconds count from the fault, ``recovered_after_s`` from its end. None: it did not happen."""

    fault: str
    detected_after_s: float | None = None
    """A service is reported lost, or the gate stops."""
    stop_bytes_after_s: float | None = None
    """On the drive controller's wire."""
    stop_bytes_after_sample_s: float | None = None
    """From the arrival of the last good sample of the spoilt device."""
    standstill_after_s: float | None = None
    """Of the world's truth."""
    metres: float = 0.0
    """Truly travelled, to standstill or to the end of the fault."""
    reason: Reason | None = None
    """First reason for which the gate stopped the truck."""
    seen: tuple[Reason, ...] = ()
    """What the gate's state and events named during the fault, in order."""
    down: Mapping[str, tuple[Reason, ...]] = field(default_factory=dict)
    """Services that were lost during the fault, and why."""
    top_speed: float = 0.0
    """Greatest true speed during the fault, m/s."""
    healed_after_s: float = 0.0
    recovered_after_s: float | None = None
    """All services ready, and nothing but an order missing to drive."""
    moved_by_itself: bool = False
    """After the fault, before anybody armed the truck again."""
    drove_again: bool = False
    resets: int = 0
    """Fault resets the drive controller was sent."""
    collided: bool = False
    exited: bool = False
