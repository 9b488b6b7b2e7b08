"""Paths drawn beforehand or sent from outside, published for the trackers."""

import csv
from pathlib import Path as FilePath
from typing import Final

import numpy as np

from monstertruck_planners.track.segments import check_path
from monstertruck_runtime.clock import Clock
from monstertruck_runtime.errors import InputError, RequestRefusedError
from monstertruck_runtime.ports import EventSink, Publisher, Ready, Subscription
from monstertruck_runtime.requests import Sequences, examine
from monstertruck_runtime.small_files import require_file
from monstertruck_schemas.event import Severity
from monstertruck_schemas.plan import BehaviourState, Path
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import PathRequest
from monstertruck_schemas.roles import ServiceName
from monstertruck_schemas.state import GateState

HEADER = ["x", "y", "yaw", "direction"]
MOST_BYTES: Final = 10_000_000
"""Size of a file of poses at most: a hundred thousand and more."""


def load_path(file: FilePath, *, closed: bool, frame: str = "odom") -> Path:
    """Read a path in ``frame`` from CSV: header ``x,y,yaw,direction``; metres, metres, radians, +1 or -1.

    Raises:
        InputError: naming file and line, and what was expected.
    """
    try:
        require_file(file, MOST_BYTES)
        with file.open(newline="", encoding="utf-8") as stream:
            rows = list(csv.reader(stream))
    except OSError as error:
        raise InputError(f"{file}: cannot be read: {error.strerror}") from error
    except (UnicodeDecodeError, csv.Error) as error:
        raise InputError(f"{file}: cannot be read: {error}") from error
    if not rows or [name.strip() for name in rows[0]] != HEADER:
        raise InputError(f"{file}:1: expected the header {','.join(HEADER)}")
    values = np.array([_numbers(file, line, row) for line, row in enumerate(rows[1:], start=2)])
    if len(values) < 2:
        raise InputError(f"{file}: expected at least two poses, found {len(values)}")
    path = Path(
        stamp=0,
        received=0,
        seq=0,
        frame=frame,
        poses=values[:, :3].ravel(),
        directions=values[:, 3],
        closed=closed,
        name=file.stem,
    )
    try:
        check_path(path)
    except InputError as error:
        raise InputError(f"{file}: {error}") from error
    return path


def _numbers(file: FilePath, line: int, row: list[str]) -> list[float]:
    try:
        numbers = [float(cell) for cell in row]
    except ValueError as error:
        raise InputError(f"{file}:{line}: expected four numbers, found {','.join(row)}") from error
    if len(numbers) != len(HEADER) or not np.isfinite(numbers).all() or numbers[3] not in (1.0, -1.0):
        raise InputError(f"{file}:{line}: expected x,y,yaw and a direction of 1 or -1, found {','.join(row)}")
    return numbers


class PathService:
    """Publishes the configured path, and replaces it by any that an operator sends while the truck stands.

    A request for the present path that ``halts`` withdraws it, whether the truck stands or not.

    Args:
        drawn: the configured path.
        clock: time.
        requests: ``req/path``.
        gate: state of the gate.
        behaviour: ``plan/behaviour``.
        present: ``plan/path``, others' paths as well.
        out: ``plan/path``.
        events: where events go.
        max_age: seconds; see ``GateConfig.max_request_age``.
    """

    name = ServiceName.PATH.value

    def __init__(
        self,
        drawn: Path | None,
        clock: Clock,
        requests: Subscription[PathRequest],
        gate: Subscription[GateState],
        behaviour: Subscription[BehaviourState],
        present: Subscription[Path],
        out: Publisher[Path],
        events: EventSink,
        max_age: float,
    ) -> None:
        self._drawn = drawn
        self._clock = clock
        self._requests = requests
        self._gate = gate
        self._behaviour = behaviour
        self._present = present
        self._out = out
        self._events = events
        self._max_age = max_age
        self._sequences = Sequences(max_age)

    async def run(self, ready: Ready) -> None:
        """Publish, then serve requests until cancelled."""
        if self._drawn is not None:
            self._publish(self._drawn)
        ready()
        while True:
            request = await self._requests.next()
            try:
                path = self._withdrawn(request) if request.path.halts else self._examined(request)
            except RequestRefusedError as error:
                self._events(error.refusal, Severity.WARNING, request.source, f"path refused: {error}")
            except InputError as error:
                self._events(Reason.BAD_INPUT, Severity.WARNING, request.source, f"path refused: {error}")
            else:
                self._publish(path)

    def _withdrawn(self, request: PathRequest) -> Path:
        """The present path, to be followed no longer than until the truck is disarmed.

        Raises:
            RequestRefusedError: the sender may not, or the path has been replaced.
        """
        examine(request, self._gate.latest, self._sequences, self._clock.now(), None)
        present = self._present.latest
        if present is None or present.name != request.path.name:
            raise RequestRefusedError(Reason.NOT_FOUND, f"path {request.path.name!r} is not the present one")
        return present.model_copy(update={"halts": True})

    def _examined(self, request: PathRequest) -> Path:
        """The path of a request.

        Authority as for driving, and only while the truck stands: a path must not turn under it.

        Raises:
            RequestRefusedError: the sender may not, or not now.
            InputError: the path cannot be tracked.
        """
        gate = self._gate.latest
        examine(request, gate, self._sequences, self._clock.now(), self._max_age)
        if gate is not None and gate.mode.moving:
            raise RequestRefusedError(Reason.BUSY, f"the robot is {gate.mode}, stop it first")
        behaviour = self._behaviour.latest
        if behaviour is not None and behaviour.running:
            raise RequestRefusedError(Reason.BUSY, f"the behaviour {behaviour.behaviour} is running, stop it first")
        check_path(request.path)
        return request.path

    def _publish(self, path: Path) -> None:
        now = self._clock.now()
        self._out.put(path.model_copy(update={"stamp": now, "received": now, "seq": self._out.next_seq()}))
