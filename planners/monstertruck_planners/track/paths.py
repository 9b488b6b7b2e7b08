"""Publisher of configured paths and operators' paths for the trackers."""

from collections.abc import Callable, Sequence
from pathlib import Path as FilePath
from typing import Any

from monstertruck_planners.track.segments import check_path
from monstertruck_runtime.clock import Clock
from monstertruck_runtime.errors import InputError, NotFoundError, RequestRefusedError
from monstertruck_runtime.outside import text_of
from monstertruck_runtime.path_files import EXPECTED, LARGEST_PATH_FILE, path_from
from monstertruck_runtime.ports import EventSink, Publisher, Ready, RpcRegistry, Subscription
from monstertruck_runtime.requests import Sequences, does_not_drive, examine, parse_request
from monstertruck_runtime.threads import Offload
from monstertruck_schemas.event import Severity
from monstertruck_schemas.plan import BehaviourState, Path
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import PathRequest, PathStart, Request
from monstertruck_schemas.roles import ServiceName
from monstertruck_schemas.state import GateState


def load_path(file: FilePath, *, closed: bool, frame: str = "odom", columns: Sequence[str] = ()) -> Path:
    """Load a path for tracking; see ``path_from``.

    Raises:
        InputError: the file is invalid; the error names file, line and expected value.
    """
    path = path_from(text_of(file, EXPECTED, LARGEST_PATH_FILE), file, closed=closed, frame=frame, columns=columns)
    try:
        check_path(path)
    except InputError as error:
        raise InputError(f"{file}: {error}") from error
    return path


class PathService:
    """Publish the configured path, and replace it by a path that an operator sends while the truck stands.

    A request that repeats the current path with ``halts`` withdraws it, even while the truck drives. The configured
    path, if started by name, is driven once: a truck disarmed during it does not continue when armed again.

    A path that the body cannot drive is refused, with the place of the first impossible bend.

    Args:
        drawn: configured path, which the body can drive.
        at_once: follow it as soon as the truck is armed, without a start by name.
        clock: the service's clock.
        requests: ``req/path``.
        gate: state of the gate.
        behaviour: ``plan/behaviour``.
        present: ``plan/path``, including paths of other sources.
        out: publisher of ``plan/path``.
        events: event sink.
        max_age: maximum age of a request (s); see ``GateConfig.max_request_age``.
        require_drivable: raises an ``InputError`` for a path that the body cannot drive; takes up to 0.2 s.
        offload: runs that check outside the event loop.
    """

    name = ServiceName.PATH.value

    def __init__(
        self,
        drawn: Path | None,
        at_once: bool,
        clock: Clock,
        requests: Subscription[PathRequest],
        gate: Subscription[GateState],
        behaviour: Subscription[BehaviourState],
        present: Subscription[Path],
        out: Publisher[Path],
        events: EventSink,
        max_age: float,
        require_drivable: Callable[[Path], None],
        offload: Offload,
    ) -> None:
        self._drawn = drawn
        self._at_once = at_once
        self._clock = clock
        self._requests = requests
        self._gate = gate
        self._behaviour = behaviour
        self._present = present
        self._out = out
        self._events = events
        self._max_age = max_age
        self._require_drivable = require_drivable
        self._offload = offload
        self._sequences = Sequences(max_age)
        self._start_sequences = Sequences(max_age)

    async def run(self, ready: Ready) -> None:
        """Publish, then serve requests until cancelled."""
        if self._drawn is not None and self._at_once:
            self._publish(self._drawn)
        ready()
        while True:
            request = await self._requests.next()
            try:
                path = self._withdrawn(request) if request.path.halts else await self._examined(request)
            except RequestRefusedError as error:
                self._events(error.refusal, Severity.WARNING, request.source, f"path refused: {error}")
            except InputError as error:
                self._events(Reason.BAD_INPUT, Severity.WARNING, request.source, f"path refused: {error}")
            else:
                self._publish(path)

    def start(self, request: PathStart) -> str:
        """Let the armed truck follow the configured path from now on; return its name.

        Raises:
            NotFoundError: the configuration has no path of this name.
            RequestRefusedError: the sender lacks permission, or the truck's state does not allow it.
        """
        drawn, gate = self._drawn, self._gate.latest
        if drawn is None or drawn.name != request.path:
            there = "no path" if drawn is None else f"the path {drawn.name!r}"
            raise NotFoundError(f"no path {request.path!r}: the configuration has {there}")
        self._examine(request, self._start_sequences)
        if gate is None or not gate.mode.active:
            raise does_not_drive(gate)
        name = f"{drawn.name[:96]}-{self._clock.now():x}"
        self._publish(drawn.model_copy(update={"name": name, "halts": True}))
        return name

    def _withdrawn(self, request: PathRequest) -> Path:
        """Return the current path; the truck follows it until it is disarmed, at most.

        Raises:
            RequestRefusedError: the sender lacks permission, or the path has been replaced.
        """
        examine(request, self._gate.latest, self._sequences, self._clock.now(), None)
        present = self._present.latest
        if present is None or present.name != request.path.name:
            raise RequestRefusedError(Reason.NOT_FOUND, f"path {request.path.name!r} is not the current one")
        return present.model_copy(update={"halts": True})

    async def _examined(self, request: PathRequest) -> Path:
        """Return the path of a request.

        Raises:
            RequestRefusedError: the sender lacks permission, or the truck's state does not allow it.
            InputError: the body cannot drive the path.
        """
        self._examine(request, self._sequences)
        check_path(request.path)
        await self._offload(lambda: self._require_drivable(request.path))
        self._require_rest()
        return request.path

    def _examine(self, request: Request, sequences: Sequences) -> None:
        """Require driving authority and a truck at standstill: its path must not change while it moves.

        Raises:
            RequestRefusedError: the sender lacks permission, or the truck's state does not allow it.
        """
        examine(request, self._gate.latest, sequences, self._clock.now(), self._max_age)
        self._require_rest()

    def _require_rest(self) -> None:
        gate = self._gate.latest
        if gate is not None and gate.mode.moving:
            raise RequestRefusedError(Reason.BUSY, f"the robot is {gate.mode}, stop it first")
        behaviour = self._behaviour.latest
        if behaviour is not None and behaviour.running:
            raise RequestRefusedError(Reason.BUSY, f"{behaviour.activity}, stop it first")

    def _publish(self, path: Path) -> None:
        now = self._clock.now()
        self._out.put(path.model_copy(update={"stamp": now, "received": now, "seq": self._out.next_seq()}))

    def register(self, rpc: RpcRegistry) -> None:
        """Serve ``start_path`` with a ``PathStart`` as payload; the answer contains the followed ``path``."""

        async def start_path(payload: dict[str, Any]) -> dict[str, Any]:
            return {"path": self.start(parse_request(PathStart, payload))}

        rpc.register("start_path", start_path)
