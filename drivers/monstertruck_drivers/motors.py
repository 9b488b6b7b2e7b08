"""Base class of the drivers that command all shafts of one board in one exchange per cycle.

The shafts share one state, set by their most cautious command and the age of the oldest one. A stop is sent
immediately, and any other command in the next cycle.
"""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Generic, Protocol, TypedDict, TypeVar

from monstertruck_drivers.link import Link, Port
from monstertruck_drivers.transaction import Misses
from monstertruck_runtime.clock import SECOND, Clock, Lead, Schedule
from monstertruck_runtime.ports import EventSink, Publisher, Ready, Subscription
from monstertruck_schemas.cmd import DriveAction, DriveCommand
from monstertruck_schemas.sensor import DriveFeedback, DriveMode


class MotorSettings(Protocol):
    """Driver settings that the base class reads."""

    @property
    def rate(self) -> float:
        """Exchanges per second."""


class ShaftEnds(TypedDict):
    """Topics of the shafts, named as in the catalog."""

    commands: Subscription[DriveCommand]
    """``cmd/drive`` of the first shaft."""
    commands_2: Subscription[DriveCommand]
    commands_3: Subscription[DriveCommand]
    commands_4: Subscription[DriveCommand]
    out: Publisher[DriveFeedback]
    """``sensor/drive`` of the first shaft, ``stamp`` in the middle of the exchange."""
    out_2: Publisher[DriveFeedback]
    out_3: Publisher[DriveFeedback]
    out_4: Publisher[DriveFeedback]


Settings = TypeVar("Settings", bound=MotorSettings)
Session = TypeVar("Session")


def requested(
    commands: Sequence[DriveCommand | None], now: int, timeout: float
) -> tuple[DriveMode, list[DriveCommand]]:
    """Combine the latest commands of all shafts into one state.

    Args:
        commands: latest command for each shaft, if any.
        now: current time (ns).
        timeout: maximum age of a command (s); an older one stops the motors.

    Returns:
        DISABLED, QUICK_STOP or ENABLED, and the existing commands; if ENABLED, one for each shaft.
    """
    known = [command for command in commands if command is not None]
    if len(known) < len(commands) or any(command.action is DriveAction.DISABLE for command in known):
        return DriveMode.DISABLED, known
    stale = any(now - command.stamp > timeout * SECOND for command in known)
    if stale or any(command.action is DriveAction.QUICK_STOP for command in known):
        return DriveMode.QUICK_STOP, known
    return DriveMode.ENABLED, known


class MotorBoard(ABC, Generic[Settings, Session]):
    """Drive service for the motors on one board.

    Args:
        config: driver settings.
        port: the board's port.
        clock: time.
        shafts: number of driven shafts.
        events: identity, restarts and faults.
        name: service name.
        ends: the shafts' topics.
    """

    def __init__(
        self,
        config: Settings,
        port: Port,
        clock: Clock,
        shafts: int,
        events: EventSink,
        name: str,
        ends: ShaftEnds,
    ) -> None:
        self.name = name
        self._config = config
        self._port = port
        self._clock = clock
        self._events = events
        self._commands = (ends["commands"], ends["commands_2"], ends["commands_3"], ends["commands_4"])[:shafts]
        self._outs = (ends["out"], ends["out_2"], ends["out_3"], ends["out_4"])[:shafts]
        self._sent = DriveMode.DISABLED
        """State last requested from the board."""

    async def run(self, ready: Ready) -> None:
        """Serve one session. The motors are stopped at its start, because they may still be turning, and at its end.

        Raises:
            DeviceLostError: no board is plugged in, or the link went down.
            PortBusyError: another process holds the port.
            DeviceTimeoutError, ProtocolError: no usable answers.
            DeviceError: see ``_start`` and ``_exchange`` of the driver.
        """
        async with await self._port.open() as link:
            session = self._session(link)
            try:
                await self._start(session)
                await self._serve(session, ready)
            finally:
                if not link.is_lost:
                    await self._make_safe(session)

    async def _serve(self, session: Session, ready: Ready) -> None:
        schedule = Schedule(self._clock, self._config.rate, Lead.POLLING)
        misses, reported = Misses(), False
        due = 0
        while True:
            if self._clock.now() >= due:
                due = schedule.step()
            await self._until(due)
            with misses:
                await self._exchange(session)
            if not misses.count and not reported:
                reported = True
                ready()

    def _latest(self) -> list[DriveCommand | None]:
        return [commands.latest for commands in self._commands]

    def _is_urgent(self) -> bool:
        """Whether a stop or a power-off still has to be sent to the motors."""
        wanted = self._wanted()
        return wanted is not DriveMode.ENABLED and wanted is not self._sent

    async def _until(self, due: int) -> None:
        """Wait for the next cycle, or for a command that stops running motors."""
        while (left := due - self._clock.now()) > 0:
            last = self._commands[-1]
            if await last.next_within(left / SECOND, lambda _: not self._is_urgent()) is None or self._is_urgent():
                return

    @abstractmethod
    def _session(self, link: Link) -> Session:
        """Create the session for an open link."""

    @abstractmethod
    async def _start(self, session: Session) -> None:
        """Stop the motors, identify the board and send its settings."""

    @abstractmethod
    def _wanted(self) -> DriveMode:
        """Return the state requested by the latest commands."""

    @abstractmethod
    async def _exchange(self, session: Session) -> None:
        """Send the set-points, set ``_sent``, and publish the board's answer."""

    @abstractmethod
    async def _make_safe(self, session: Session) -> None:
        """Stop the motors at the end of a session; raises only on cancellation."""
