"""Picture of the path over the scan map: feeds the rendering worker and saves its pictures."""

import math
from typing import Any

import numpy as np

from monstertruck_planners.collision import scan_points
from monstertruck_runtime.actors.actor import WorkerActor
from monstertruck_runtime.clock import Clock
from monstertruck_runtime.mailbox import Mailbox
from monstertruck_runtime.ports import EventSink, Ready, Subscription
from monstertruck_schemas.body import Mount
from monstertruck_schemas.event import Severity
from monstertruck_schemas.plan import Path, TrackerState
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.roles import ServiceName
from monstertruck_schemas.sensor import LaserScan
from monstertruck_schemas.state import Odometry
from monstertruckd.recorder.config import MapRender

TARGET = "monstertruckd.recorder.picture_worker:MapRenderer"


class MapService:
    """Passes one scan per period to the worker; saves the picture whenever a path has ended.

    Args:
        config: periods, deadline and file.
        mount: mounting pose of the lidar.
        clock: time source.
        scan: lidar scans.
        pose: pose in the map frame.
        path: tracked path.
        tracker: progress along the path.
        events: receives an event for each finished picture.
    """

    name = ServiceName.MAP.value

    def __init__(
        self,
        config: MapRender,
        mount: Mount,
        clock: Clock,
        *,
        scan: Subscription[LaserScan],
        pose: Subscription[Odometry],
        path: Subscription[Path],
        tracker: Mailbox[TrackerState],
        events: EventSink,
    ) -> None:
        self._config = config
        self._mount = mount.planar
        self._clock = clock
        self._scan = scan
        self._pose = pose
        self._path = path
        self._tracker = tracker
        self._events = events
        self._driven: list[tuple[float, float, float]] = []
        self._spacing = 0.02  # initial spacing of the remembered poses of the driven path (m)
        self._before = Reason.DRIVING

    async def run(self, ready: Ready) -> None:
        """Feed the worker until cancelled.

        Raises:
            WorkerError: the worker failed, hung or died; the next session starts an empty map.
        """
        worker = WorkerActor("map", TARGET, self._clock, latency=self._config.latency, deadline=self._config.deadline)
        async with worker:
            await worker.start()
            ready()
            while True:
                await self._clock.sleep(self._config.period)
                scans = self._new_scan()
                ended = self._ended()
                if self._config.picture is not None and ended is not None:
                    file = str(self._config.picture)
                    outputs = await worker.step({"scans": scans, "render": self._picture(ended), "file": file})
                    if (error := outputs.get("error")) is not None:
                        self._events(Reason.BAD_INPUT, Severity.WARNING, self.name, f"picture not saved: {error}")
                elif scans:
                    await worker.step({"scans": scans})

    def _ended(self) -> TrackerState | None:
        """Return the state at the end of a path since the last check, however briefly that state was reported."""
        ended = None
        for state in self._tracker.drain():
            if state.outcome is not Reason.DRIVING and self._before is Reason.DRIVING:
                ended = state
            self._before = state.outcome
        return ended

    def _new_scan(self) -> list[tuple[tuple[float, float, float], Any]]:
        scan, odometry = self._scan.latest, self._pose.latest
        if scan is None or odometry is None:
            return []
        pose = (odometry.pose.x, odometry.pose.y, odometry.pose.yaw)
        if not self._driven or math.dist(pose[:2], self._driven[-1][:2]) > self._spacing:
            self._driven.append(pose)
            if len(self._driven) > 2000:  # poses kept; beyond, every other one is dropped and the spacing doubles
                self._driven = self._driven[::2]
                self._spacing *= 2
        if scan.tilt is not None and scan.tilt > self._config.max_tilt:
            return []
        return [(pose, scan_points(scan, self._mount))]

    def _picture(self, ended: TrackerState) -> dict[str, Any]:
        path = self._path.latest
        paths = [{"name": "driven (estimated)", "style": "driven", "poses": np.array(self._driven).reshape(-1, 3)}]
        if path is not None:
            paths.insert(0, {"name": "planned", "style": "planned", "poses": path.poses.reshape(-1, 3)})
        along = f"{ended.along:.2f} of {ended.length:.2f} m"
        title = f"Path {path.name if path else ''} over the scan map"
        return {"title": title, "subtitle": f"{ended.outcome.text}, {along}", "paths": paths}
