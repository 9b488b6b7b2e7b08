"""Publishes the planning map of a robot without mapping, so that operators see it."""

import asyncio
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import TYPE_CHECKING, Final

from monstertruck_runtime.clock import Clock
from monstertruck_runtime.errors import InputError
from monstertruck_runtime.ports import EventSink, Publisher, Ready
from monstertruck_schemas.base import Pose2D
from monstertruck_schemas.event import Severity
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.roles import ServiceName
from monstertruck_schemas.state import Grid

if TYPE_CHECKING:
    from monstertruck_runtime.map_files import WorldMap

Offload = Callable[[Callable[[], "WorldMap"]], Awaitable["WorldMap"]]
"""Runs a function that accesses the file system."""

NAME: Final = ServiceName.KNOWN_MAP.value


class KnownMapService:
    """Reads the planning map once and publishes it on a retained topic.

    Args:
        place: map_server YAML, or the folder of a saved map.
        frame: frame of the map.
        clock: time source.
        out: publisher of ``state/map``.
        events: event sink.
        offload: reads the file outside the event loop.
    """

    name = NAME

    def __init__(
        self, place: Path, frame: str, clock: Clock, out: Publisher[Grid], events: EventSink, offload: Offload
    ) -> None:
        self._place, self._frame, self._clock = place, frame, clock
        self._out, self._events, self._offload = out, events, offload

    async def run(self, ready: Ready) -> None:
        """Publish, then wait until cancelled."""
        try:
            self._publish(await self._offload(self._load))
        except InputError as error:  # the planner also refuses it
            self._events(Reason.FILE_DAMAGED, Severity.WARNING, NAME, f"{error}; operators see no map")
        ready()
        await asyncio.Event().wait()

    def _load(self) -> "WorldMap":
        from monstertruck_runtime.map_files import load_map  # noqa: PLC0415  # reads pictures: not at the daemon's start

        return load_map(self._place)

    def _publish(self, known: "WorldMap") -> None:
        height, width = known.cells.shape
        x, y = known.origin
        now = self._clock.now()
        self._out.put(
            Grid(
                stamp=now,
                received=now,
                seq=self._out.next_seq(),
                frame=self._frame,
                resolution=known.resolution,
                width=width,
                height=height,
                origin=Pose2D(x=x, y=y, yaw=0.0),
                cells=known.cells.ravel(),
            )
        )
