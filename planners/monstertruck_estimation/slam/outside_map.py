"""Off-board map: publishes occupancy grids sent by clients."""

import zlib
from collections.abc import Awaitable, Callable
from functools import partial

import numpy as np
from numpy.typing import NDArray

from monstertruck_runtime.clock import Clock
from monstertruck_runtime.errors import RequestRefusedError
from monstertruck_runtime.mailbox import Mailbox
from monstertruck_runtime.ports import EventSink, Publisher, Subscription
from monstertruck_runtime.requests import Sequences, examine
from monstertruck_schemas.event import Severity
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import MapRequest
from monstertruck_schemas.roles import ServiceName
from monstertruck_schemas.state import GateState, Grid

Cells = NDArray[np.int8]
Offload = Callable[[Callable[[], Cells]], Awaitable[Cells]]
"""Runs a computation outside the event loop."""


def unpacked(request: MapRequest) -> Cells:
    """Return the cells of a map, shape (height * width,).

    Raises:
        RequestRefusedError: the cells are not zlib data, too few or too many, or outside -1..100.
    """
    count, reader = request.width * request.height, zlib.decompressobj()
    try:
        cells = np.frombuffer(reader.decompress(request.packed, count + 1), np.int8)
    except zlib.error as error:
        raise RequestRefusedError(Reason.BAD_INPUT, f"map: compressed data: {error}") from None
    if len(cells) != count:
        more = "more than" if len(cells) > count else f"{len(cells)} of"
        raise RequestRefusedError(Reason.BAD_INPUT, f"map: {more} {count} cells")
    if cells.min() < -1 or cells.max() > 100:
        raise RequestRefusedError(Reason.BAD_INPUT, "map: cells: expected -1 to 100")
    return cells


class OutsideMap:
    """Publish the latest map of an operator.

    A request needs nonce, sequence and role like a drive request. It causes no motion, so its age is not limited.

    Args:
        clock: the service's clock.
        requests: ``req/map``.
        gate: state of the gate.
        out: publisher of ``state/map``.
        events: sink of refusals.
        offload: unpacks cells outside the event loop.
    """

    def __init__(
        self,
        clock: Clock,
        requests: Mailbox[MapRequest],
        gate: Subscription[GateState],
        out: Publisher[Grid],
        events: EventSink,
        offload: Offload,
    ) -> None:
        self._clock, self._requests, self._gate = clock, requests, gate
        self._out, self._events, self._offload = out, events, offload
        self._sequences = Sequences()

    async def run(self) -> None:
        """Serve until cancelled."""
        async for request in self._requests:
            try:
                examine(request, self._gate.latest, self._sequences, self._clock.now(), None)
                self._publish(request, await self._offload(partial(unpacked, request)))
            except RequestRefusedError as error:
                text = f"map of {request.source} refused: {error}"
                self._events(error.refusal, Severity.WARNING, ServiceName.SLAM.value, text)

    def _publish(self, request: MapRequest, cells: Cells) -> None:
        now = self._clock.now()
        self._out.put(
            Grid(
                stamp=now,
                received=now,
                seq=self._out.next_seq(),
                frame="map",
                resolution=request.resolution,
                width=request.width,
                height=request.height,
                origin=request.origin,
                cells=cells,
            )
        )
