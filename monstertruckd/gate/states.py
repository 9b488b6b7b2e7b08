"""The gate's state, who drives, and the transitions between states; each is told as it happens."""

from collections.abc import Iterable
from typing import Final

from monstertruck_schemas.event import Severity
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.state import GateMode
from monstertruckd.gate.events import EventLog
from monstertruckd.gate.sources import Key, Source

MEANS: Final = {GateMode.ESTOPPED: (Reason.ESTOPPED,), GateMode.DISARMED: (Reason.DISARMED,)}
"""What a state itself means for driving."""


class States:
    """Disarmed > armed > driving > stopping > (armed | disarmed); an emergency stop from any state latches.

    Args:
        events: where transitions are told.
        latched: whether it begins with the emergency stop latched.
    """

    def __init__(self, events: EventLog, *, latched: bool) -> None:
        self._events = events
        self.mode = GateMode.ESTOPPED if latched else GateMode.DISARMED
        self.since = 0
        """When it came into this state, ns."""
        self.holder: Source | None = None
        """Whoever drives; None in every state but driving."""
        self.driven = 0
        """When somebody last drove, or the truck was armed, ns."""
        self.disarm_at_rest = False
        """It will be disarmed as soon as it stands."""
        self._stopped_by: tuple[Reason, ...] = ()

    @property
    def active(self) -> bool:
        """Whether the truck is armed, drives, or is being stopped."""
        return self.mode.active

    @property
    def reasons(self) -> tuple[Reason, ...]:
        """What the state itself means for driving."""
        return MEANS.get(self.mode, self._stopped_by)

    @property
    def holder_key(self) -> Key | None:
        """What tells the driver from all other sources."""
        return None if self.holder is None else self.holder.key

    @property
    def holder_name(self) -> str | None:
        """The driver's name."""
        return None if self.holder is None else self.holder.request.source

    def arm(self, now: int, by: str) -> None:
        """A human allows driving; an armed truck stays so for longer."""
        self.driven = now
        if self.mode is GateMode.DISARMED:
            self._enter(GateMode.ARMED, now)
            self.disarm_at_rest = False
            self._events.tell(now, Reason.ARMED, Severity.INFO, source=by, always=True)

    def drive(self, now: int, driver: Source) -> None:
        """``driver`` drives, from now on or still."""
        if self.mode is not GateMode.DRIVING:
            self._enter(GateMode.DRIVING, now)
        if self.holder_key != driver.key:
            request = driver.request
            values = {"role": request.role.value}
            self._events.tell(now, Reason.DRIVING, Severity.INFO, "", values, source=request.source, always=True)
        self.holder, self.driven = driver, now

    def stop(self, now: int, reasons: Iterable[Reason]) -> None:
        """The truck is being stopped."""
        self._enter(GateMode.STOPPING, now)
        self._stopped_by = tuple(dict.fromkeys(reasons))

    def release(self, now: int) -> None:
        """The driver has let go of a truck that stands."""
        text = f"{self.holder_name} let go"
        self._enter(GateMode.ARMED, now)
        self._events.tell(now, Reason.STOPPED, Severity.INFO, text)

    def rest(self, now: int) -> None:
        """It stands."""
        self._enter(GateMode.ARMED, now)
        self._events.tell(now, Reason.STOPPED, Severity.INFO, always=True)

    def disarm(self, now: int, text: str) -> None:
        """Somebody has to arm it again."""
        self._enter(GateMode.DISARMED, now)
        self.disarm_at_rest = False
        self._events.tell(now, Reason.DISARMED, Severity.INFO, text, always=True)

    def latch(self, now: int) -> None:
        """Emergency stop."""
        self._enter(GateMode.ESTOPPED, now)

    def _enter(self, mode: GateMode, now: int) -> None:
        self.mode, self.since, self.holder, self._stopped_by = mode, now, None, ()
