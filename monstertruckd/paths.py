"""Paths drawn beforehand or sent from outside, published for the trackers."""

import csv
from pathlib import Path as FilePath

import numpy as np

from monstertruck_runtime.clock import Clock
from monstertruck_runtime.errors import InputError
from monstertruck_runtime.ports import EventSink, Publisher, Ready, Subscription
from monstertruck_schemas.event import Severity
from monstertruck_schemas.plan import Path
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import PathRequest
from monstertruck_schemas.state import GateState

HEADER = ["x", "y", "yaw", "direction"]


def load_path(file: FilePath, *, closed: bool) -> Path:
    """Read a path from CSV: header ``x,y,yaw,direction``; metres, metres, radians, +1 or -1.

    Raises:
        InputError: naming file and line, and what was expected.
    """
    try:
        with file.open(newline="", encoding="utf-8") as stream:
            rows = list(csv.reader(stream))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise InputError(f"{file}: cannot be read: {error}") from error
    if not rows or [name.strip() for name in rows[0]] != HEADER:
        raise InputError(f"{file}:1: expected the header {','.join(HEADER)}")
    values = np.array([_numbers(file, line, row) for line, row in enumerate(rows[1:], start=2)])
    if len(values) < 2:
        raise InputError(f"{file}: expected at least two poses, found {len(values)}")
    return Path(
        stamp=0,
        received=0,
        seq=0,
        frame="odom",
        poses=values[:, :3].ravel(),
        directions=values[:, 3],
        closed=closed,
        name=file.stem,
    )


def _numbers(file: FilePath, line: int, row: list[str]) -> list[float]:
    try:
        numbers = [float(cell) for cell in row]
    except ValueError as error:
        raise InputError(f"{file}:{line}: expected four numbers, found {','.join(row)}") from error
    if len(numbers) != len(HEADER) or not np.isfinite(numbers).all() or numbers[3] not in (1.0, -1.0):
        raise InputError(f"{file}:{line}: expected x,y,yaw and a direction of 1 or -1, found {','.join(row)}")
    return numbers


class PathService:
    """Publishes the configured path, and replaces it by any that an operator sends."""

    name = "path"

    def __init__(
        self,
        drawn: Path | None,
        clock: Clock,
        requests: Subscription[PathRequest],
        gate: Subscription[GateState],
        out: Publisher[Path],
        events: EventSink,
    ) -> None:
        self._drawn = drawn
        self._clock = clock
        self._requests = requests
        self._gate = gate
        self._out = out
        self._events = events

    async def run(self, ready: Ready) -> None:
        """Publish, then serve requests until cancelled."""
        if self._drawn is not None:
            self._publish(self._drawn)
        ready()
        while True:
            request = await self._requests.next()
            refusal = self._refusal(request)
            if refusal is None:
                self._publish(request.path)
            else:
                self._events(refusal, Severity.WARNING, request.source, f"path refused: {refusal.text}")

    def _refusal(self, request: PathRequest) -> Reason | None:
        gate = self._gate.latest
        if gate is None or request.nonce != gate.nonce:
            return Reason.BAD_NONCE
        path = request.path
        count = len(path.poses) // 3
        if len(path.poses) != 3 * count or count < 2 or len(path.directions) not in (0, count):
            return Reason.BAD_INPUT
        if not (np.isfinite(path.poses).all() and np.isfinite(path.directions).all()):
            return Reason.NOT_FINITE
        return None

    def _publish(self, path: Path) -> None:
        now = self._clock.now()
        self._out.put(path.model_copy(update={"stamp": now, "received": now, "seq": self._out.next_seq()}))
