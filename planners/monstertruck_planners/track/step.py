"""The tracker as a step: what came in since the last one, what goes out; for a worker or another machine.

Inside is the very service that runs in the loop, with its mailboxes filled by hand.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

from monstertruck_kinematics.truck import FourWheelSteering
from monstertruck_planners.collision import Footprint, ScanPoints
from monstertruck_planners.goals.exchange import Pose
from monstertruck_planners.track.config import TrackerConfig
from monstertruck_planners.track.service import TrackerService
from monstertruck_runtime.errors import InputError
from monstertruck_runtime.ports import Value
from monstertruck_schemas.base import Message
from monstertruck_schemas.event import Severity
from monstertruck_schemas.plan import TrackerState
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import DriveRequest

M = TypeVar("M", bound=Message)

INPUTS = ("pose", "path", "gate", "scan", "attitude")


@dataclass(frozen=True, slots=True)
class TrackSetup:
    """What the step is made for; comes first, and again after every restart."""

    config: TrackerConfig
    steering: FourWheelSteering
    footprint: Footprint
    lidar: Pose
    scan: bool
    attitude: bool


@dataclass(frozen=True, slots=True)
class TrackInput:
    """One control step at ``now``, ns, with the messages that are newer than at the step before, by input."""

    now: int
    news: dict[str, Any]
    setup: TrackSetup | None = None


@dataclass(frozen=True, slots=True)
class Told:
    """An event of the step."""

    reason: Reason
    severity: Severity
    source: str
    text: str
    values: dict[str, Value]


@dataclass(frozen=True, slots=True)
class TrackOutput:
    """What the step has to say."""

    drive: tuple[DriveRequest, ...]
    tracker: tuple[TrackerState, ...]
    events: tuple[Told, ...]


class _Slot(Generic[M]):
    """A subscription that holds one message."""

    def __init__(self) -> None:
        self.latest: M | None = None
        self.drops = 0

    async def next(self) -> M:
        raise RuntimeError("a step does not wait")

    async def next_within(self, seconds: float, take: Callable[[M], bool] | None = None) -> M | None:
        raise RuntimeError(f"a step does not wait {seconds} s")


class _Out(Generic[M]):
    """A publisher that keeps what it is given; sequence numbers are the caller's."""

    def __init__(self) -> None:
        self.messages: list[M] = []

    def next_seq(self) -> int:
        return 0

    def put(self, message: M) -> None:
        self.messages.append(message)

    def taken(self) -> tuple[M, ...]:
        messages, self.messages = tuple(self.messages), []
        return messages


class _Stepped(TrackerService):
    """The service, driven by hand."""

    def step(self, now: int) -> None:
        """One control step."""
        for _ in self._parts(now):
            pass


class TrackingWorker:
    """Keeps the tracker and the newest messages."""

    def __init__(self) -> None:
        self._service: _Stepped | None = None
        self._slots: dict[str, _Slot[Any]] = {}
        self._drive: _Out[DriveRequest] = _Out()
        self._tracker: _Out[TrackerState] = _Out()
        self._events: list[Told] = []

    def step(self, inputs: TrackInput) -> TrackOutput:
        """Do one control step.

        Raises:
            InputError: no setup came first, or the tracker cannot be built.
        """
        if inputs.setup is not None:
            self._set_up(inputs.setup)
        if self._service is None:
            raise InputError("tracking: expected a setup before anything else")
        for name, message in inputs.news.items():
            self._slots[name].latest = message
        self._service.step(inputs.now)
        events, self._events = tuple(self._events), []
        return TrackOutput(self._drive.taken(), self._tracker.taken(), events)

    def _set_up(self, setup: TrackSetup) -> None:
        self._slots = {name: _Slot() for name in INPUTS}
        self._service = _Stepped(
            setup.config,
            _NO_CLOCK,
            steering=setup.steering,
            footprint=setup.footprint,
            points=ScanPoints(setup.lidar),
            pose=self._slots["pose"],
            path=self._slots["path"],
            gate=self._slots["gate"],
            scan=self._slots["scan"] if setup.scan else None,
            attitude=self._slots["attitude"] if setup.attitude else None,
            drive=self._drive,
            tracker=self._tracker,
            events=self._tell,
        )

    def _tell(self, reason: Reason, severity: Severity, source: str, text: str = "", **values: Value) -> None:
        self._events.append(Told(reason, severity, source, text, values))


class _NoClock:
    """The steps bring their own time."""

    def __getattr__(self, name: str) -> Any:
        raise AttributeError(f"a step has no clock: {name}")


_NO_CLOCK: Any = _NoClock()
