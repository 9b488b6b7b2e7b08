"""Zone service: publishes the zones in force and those around the robot, and handles operators' requests."""

import asyncio
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from monstertruck_planners.collision import Footprint
from monstertruck_planners.zones import files
from monstertruck_planners.zones.config import KEEPOUT_MASK, SPEED_MASK, ZonesConfig
from monstertruck_planners.zones.shapes import ZoneLayer
from monstertruck_runtime.clock import SECOND, Clock, Schedule
from monstertruck_runtime.errors import DamagedFileError, InputError, NotFoundError, RequestRefusedError, disk_reason
from monstertruck_runtime.ports import EventSink, Publisher, Ready, RpcRegistry, Subscription
from monstertruck_runtime.requests import Sequences, examine, parse_request
from monstertruck_runtime.threads import Offload
from monstertruck_schemas.event import Severity
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.roles import ServiceName
from monstertruck_schemas.state import GateState, Odometry
from monstertruck_schemas.topics import POSE
from monstertruck_schemas.zones import Zone, ZoneArea, ZoneOrder, ZoneRequest, Zones

UNKNOWN_ZONES: Final = "the robot stays at rest: repair the file or move it away, then restart the daemon"
"""What follows from a file of zones that cannot be used."""


@dataclass(frozen=True, slots=True)
class ZoneInputs:
    """Topics that the service reads."""

    gate: Subscription[GateState]
    pose: Subscription[Odometry]
    """Pose in map, or in the frame used instead."""


class ZoneService:
    """Manage the zones of one robot.

    Args:
        config: zones of the configuration.
        clock: the service's clock.
        max_speed: speed at 100 percent of a speed mask (m/s).
        footprint: outline of the robot.
        file: file of the operators' zones; None to discard them at the end.
        inputs: topics that the service reads.
        out: publisher of ``state/zones``.
        events: sink of changes.
        offload: runs file access outside the event loop.
        max_age: see ``GateConfig.max_request_age``.
    """

    name = ServiceName.ZONES.value

    def __init__(
        self,
        config: ZonesConfig,
        clock: Clock,
        *,
        max_speed: float,
        footprint: Footprint,
        file: Path | None,
        inputs: ZoneInputs,
        out: Publisher[Zones],
        events: EventSink,
        offload: Offload,
        max_age: float,
    ) -> None:
        self._config, self._clock, self._max_speed, self._footprint = config, clock, max_speed, footprint
        self._file, self._in, self._out, self._events, self._offload = file, inputs, out, events, offload
        self._sequences = Sequences(max_age)
        self._zones: dict[str, Zone] = {}
        self._areas: dict[str, ZoneArea] = {}
        """Zones made by operators."""
        self._layer = ZoneLayer()
        self._inside: frozenset[str] = frozenset()
        self._published: tuple[object, ...] | None = None
        self._writing = asyncio.Lock()

    async def run(self, ready: Ready) -> None:
        """Serve until cancelled.

        Raises:
            DamagedFileError: a file of zones cannot be used.
        """
        try:
            zones, remarks = await self._offload(lambda: files.configured(self._config, self._max_speed))
            if self._file is not None:
                file = self._file
                self._areas = await self._offload(lambda: files.load_saved(file))
        except InputError as error:
            # The file keeps its name: without it, the next start would drive through its keepout zones.
            text = f"{error}; {UNKNOWN_ZONES}"
            self._events(Reason.FILE_DAMAGED, Severity.WARNING, self.name, text)
            raise DamagedFileError(text) from error
        for remark in remarks:
            self._events(Reason.BAD_INPUT, Severity.WARNING, self.name, remark)
        made = (files.zone_of(name, area, saved=True) for name, area in self._areas.items())
        # A zone of the configuration replaces an operator's zone of the same name.
        self._replace({zone.name: zone for zone in (*made, *zones)})
        self._publish()
        ready()
        schedule = Schedule(self._clock, 5.0)  # checks per second
        while True:
            await schedule.next()
            self._expire()
            self._look()
            self._publish()

    # Observations

    def _expire(self) -> None:
        now = self._clock.now()
        for zone in list(self._zones.values()):
            if zone.off_until is not None and now >= zone.off_until:
                self._turn_on(zone, "its time off has expired")

    def _look(self) -> None:
        """Update the zones that contain the robot, while its pose is fresh."""
        odometry = self._in.pose.latest
        if odometry is None or self._clock.now() - odometry.received > POSE.fresh_for() * SECOND:
            return
        pose = (odometry.pose.x, odometry.pose.y, odometry.pose.yaw)
        entered = {shape.zone.name for shape, _ in self._layer.reached(self._footprint, pose)}
        beside = {shape.zone.name for shape, _ in self._layer.reached(self._footprint, pose, self._config.margin)}
        inside = frozenset(entered | (self._inside & beside))  # prevents repeated changes at an edge
        for name in sorted(inside - self._inside):
            zone = self._zones[name]
            alarming = zone.kind == "keepout" and zone.off_until is None
            severity = Severity.WARNING if alarming else Severity.INFO
            self._events(Reason.ZONE_ENTERED, severity, self.name, f"in the {zone.kind} zone {name}")
        for name in sorted(self._inside - inside):
            self._events(Reason.ZONE_LEFT, Severity.INFO, self.name, f"out of the zone {name}")
        self._inside = inside

    def _publish(self) -> None:
        """Publish the zones after a change."""
        zones = tuple(self._zones.values())
        inside = tuple(zone.name for zone in zones if zone.name in self._inside)
        seen = (*map(id, zones), inside)
        if seen == self._published:
            return
        self._published, now = seen, self._clock.now()
        self._out.put(Zones(stamp=now, received=now, seq=self._out.next_seq(), frame="map", zones=zones, inside=inside))

    def _replace(self, zones: Mapping[str, Zone]) -> None:
        self._zones = dict(zones)
        self._layer = ZoneLayer(self._zones.values(), self._layer)
        self._inside &= self._zones.keys()

    def _turn_on(self, zone: Zone, why: str) -> None:
        self._replace(self._zones | {zone.name: zone.model_copy(update={"off_until": None})})
        self._events(Reason.ZONE_ON, Severity.INFO, self.name, f"zone {zone.name} is on: {why}")

    # Orders

    async def take(self, request: ZoneRequest) -> None:
        """Execute a request; added and removed zones are on disk when it returns.

        Raises:
            RequestRefusedError: the sender lacks permission, or the change cannot be saved.
            NotFoundError: no zone has the given name.
            InputError: a zone of the configuration has this name, or a new zone has no area.
        """
        examine(request, self._in.gate.latest, self._sequences, self._clock.now(), None)
        name, by = request.name, request.source
        zone = self._zones.get(name)
        if request.order is ZoneOrder.ADD:
            await self._add(name, request.area, zone, by)
        elif zone is None:
            known = ", ".join(sorted(self._zones)) or "none is known"
            raise NotFoundError(f"no zone {name!r}: expected one of {known}")
        elif request.order is ZoneOrder.REMOVE:
            self._require_own(zone, "removed")
            await self._save({kept: area for kept, area in self._areas.items() if kept != name})
            self._replace({kept: other for kept, other in self._zones.items() if kept != name})
            self._events(Reason.ZONE_CHANGED, Severity.INFO, self.name, f"zone {name} removed by {by}")
        elif request.order is ZoneOrder.OFF:
            until = self._clock.now() + round(request.seconds * SECOND)
            self._replace(self._zones | {name: zone.model_copy(update={"off_until": until})})
            text = f"{zone.kind} zone {name} is off for {request.seconds:g} s, by {by}"
            self._events(Reason.ZONE_OFF, Severity.WARNING, self.name, text, seconds=request.seconds)
        elif zone.off_until is not None:
            self._turn_on(zone, f"by {by}")
        self._publish()

    async def _add(self, name: str, area: ZoneArea | None, there: Zone | None, by: str) -> None:
        if area is None:
            raise InputError("zone: area: expected for a new zone")
        if name in (KEEPOUT_MASK, SPEED_MASK):
            raise InputError(f"zone {name!r}: expected another name, because a mask has this one")
        if there is not None:
            self._require_own(there, "replaced")
        await self._save(self._areas | {name: area})
        self._replace(self._zones | {name: files.zone_of(name, area, saved=True)})
        text = f"{area.kind} zone {name} of {len(area.corners)} corners added by {by}"
        self._events(Reason.ZONE_CHANGED, Severity.INFO, self.name, text)

    @staticmethod
    def _require_own(zone: Zone, what: str) -> None:
        if not zone.saved:
            raise InputError(f"zone {zone.name!r}: is defined in the configuration: expected to be {what} there")

    async def _save(self, areas: dict[str, ZoneArea]) -> None:
        """Save the operators' zones and keep them.

        Raises:
            RequestRefusedError: the zones cannot be written, and none has changed.
        """
        if (file := self._file) is not None:
            async with self._writing:
                try:
                    await self._offload(lambda: files.save(file, areas))
                except OSError as error:
                    raise RequestRefusedError(disk_reason(error), f"zones not saved: {error}") from error
        self._areas = areas

    def register(self, rpc: RpcRegistry) -> None:
        """Serve ``zones``; each answer follows the execution of the request."""

        async def zones(payload: dict[str, Any]) -> dict[str, Any]:
            await self.take(parse_request(ZoneRequest, payload))
            return {}

        rpc.register("zones", zones)
