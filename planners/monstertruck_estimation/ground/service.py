"""Ground service: combines compass, scans and slip into a grid of tilt and roughness, publishes and saves it."""

import math
from collections import deque
from pathlib import Path
from typing import Any, Final

import numpy as np

from monstertruck_estimation.body_tilt import BodyAcceleration, Tilt
from monstertruck_estimation.ground.config import GroundConfig
from monstertruck_estimation.ground.grid import GROUND_RESOLUTION, GroundGrid, planes
from monstertruck_estimation.ground.terrain import TerrainEstimator
from monstertruck_estimation.scan_tilt import ScanAngles, plane_slopes
from monstertruck_estimation.transforms import wrap_angle
from monstertruck_kinematics.elementary import Array
from monstertruck_runtime.clock import SECOND, Clock, Schedule
from monstertruck_runtime.errors import InputError, disk_reason
from monstertruck_runtime.mailbox import Mailbox
from monstertruck_runtime.ports import EventSink, Publisher, Ready
from monstertruck_runtime.threads import Offload
from monstertruck_schemas.body import Mount
from monstertruck_schemas.event import Severity
from monstertruck_schemas.health import OdometryHealth
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.roles import ServiceName
from monstertruck_schemas.sensor import Attitude, LaserScan
from monstertruck_schemas.state import Ground, Odometry
from monstertruck_schemas.topics import FUSION, ODOMETRY

FIT_EVERY: Final = SECOND
"""Time between two fits of planes to the points (ns)."""


class GroundService:
    """Publish the ground as measured by the robot's tilt and its tilted scans.

    Args:
        config: periods.
        clock: the service's clock.
        footprint: length and width of the robot (m).
        wheelbase: wheelbase (m).
        mount: mount of the lidar; None without a lidar.
        compass: tilt of the body.
        angles: body and mount at the time of scans; None without a lidar.
        pose: pose in the routes' frame.
        scan: points on the ground; None without a lidar.
        slip: slip by the odometry.
        out: publisher of ``state/ground``.
        events: sink of load and save failures.
        offload: runs file access outside the event loop.
        load: folder of the map known at the start; None without one.
        save: folder of the saved grid, and the run that builds the map; None to save nothing.
    """

    name = ServiceName.GROUND.value

    def __init__(
        self,
        config: GroundConfig,
        clock: Clock,
        *,
        footprint: tuple[float, float],
        wheelbase: float,
        mount: Mount | None,
        compass: Mailbox[Attitude],
        angles: ScanAngles | None,
        pose: Mailbox[Odometry],
        scan: Mailbox[LaserScan] | None,
        slip: Mailbox[OdometryHealth],
        out: Publisher[Ground],
        events: EventSink,
        offload: Offload,
        load: Path | None = None,
        save: tuple[Path, str] | None = None,
    ) -> None:
        self._config, self._clock, self._wheelbase, self._mount = config, clock, wheelbase, mount
        self._compass, self._angles, self._pose, self._scan, self._slip = compass, angles, pose, scan, slip
        self._out, self._events, self._grid, self._save = out, events, GroundGrid(), save
        self._offload, self._load = offload, load
        self._cells = _spread(*footprint)
        self._terrain = TerrainEstimator(0.7)  # time constant of the roughness, s: about 0.15 m of travel
        self._moved = BodyAcceleration()
        self._felt: Tilt | None = None
        self._marked: Array | None = None
        self._travelled: tuple[float, float] | None = None
        """End of the path along which the robot's height is integrated: x and y (m)."""
        self._height = 0.0
        self._hits: deque[tuple[int, Array]] = deque()
        self._changed = False

    async def run(self, ready: Ready) -> None:
        """Observe until cancelled, then save."""
        await self._begin()
        ready()
        schedule, now = Schedule(self._clock, 10.0), self._clock.now()  # hz
        due = {"message": now, "fit": now, "save": now + round(self._config.save_period * SECOND)}
        try:
            while True:
                await schedule.next()
                now = self._clock.now()
                self._observe(now)
                if now >= due["fit"]:
                    due["fit"] = now + FIT_EVERY
                    self._fit(now)
                if now >= due["message"] and self._changed:
                    due["message"] = now + round(self._config.period * SECOND)
                    self._publish(now)
                if now >= due["save"]:
                    due["save"] = now + round(self._config.save_period * SECOND)
                    await self._keep()
        finally:
            await self._keep()

    async def _begin(self) -> None:
        """Load the grid of the known map."""
        if (folder := self._load) is None:
            return
        try:
            self._grid = await self._offload(lambda: GroundGrid.load(folder))
        except InputError as error:
            self._events(Reason.FILE_DAMAGED, Severity.WARNING, self.name, f"{error}; the ground is treated as unknown")
        self._changed = not self._grid.empty

    def _observe(self, now: int) -> None:
        for moved in self._pose.drain():
            self._moved.observe(moved)
        for attitude in self._compass.drain():
            if attitude.tilt_valid:
                self._felt = self._moved.tilt(attitude)
                self._terrain.add(attitude.stamp / SECOND, *self._felt)
        odometry, felt = self._pose.latest, self._felt
        scans = [] if self._scan is None else self._scan.drain()
        if odometry is None or felt is None or now - odometry.received > ODOMETRY.fresh_for() * SECOND:
            return
        pose = np.array((odometry.pose.x, odometry.pose.y, odometry.pose.yaw))
        self._climb(pose, felt.pitch)
        for scan in scans:
            self._see(scan, pose)
        if self._marked is None:
            self._marked = pose
        # 0.05: distance between two observations of the ground under the robot, m
        # 0.2: turn between two observations of the ground under the robot, rad
        elif np.hypot(*(pose - self._marked)[:2]) > 0.05 or abs(wrap_angle(pose[2] - self._marked[2])) > 0.2:
            self._marked = pose
            roughness = self._terrain.roughness * self._wheelbase / math.sqrt(2.0)
            if (slip := self._slip.latest) is not None and slip.slipping and self._fresh(slip, now):
                roughness = max(roughness, self._config.slip_roughness)
            self._grid.observe(_placed(self._cells, pose), self._terrain.tilt, roughness)
            self._changed = True

    def _fresh(self, slip: OdometryHealth, now: int) -> bool:
        return now - slip.received <= FUSION.fresh_for() * SECOND

    def _climb(self, pose: Array, pitch: float) -> None:
        """Integrate the robot's height along its path."""
        x, y, yaw = pose.tolist()
        if self._travelled is not None:
            forward = (x - self._travelled[0]) * math.cos(yaw) + (y - self._travelled[1]) * math.sin(yaw)
            self._height -= forward * math.sin(pitch)
        self._travelled = (x, y)

    def _see(self, scan: LaserScan, pose: Array) -> None:
        """Keep the points of a scan that hit the ground."""
        mount, angles = self._mount, None if self._angles is None else self._angles.at(scan)
        if mount is None or angles is None:
            return
        sx, sy = plane_slopes(*angles, yaw=mount.yaw)
        bearings = scan.start_angle + scan.angle_increment * np.arange(len(scan.ranges))
        rise = np.cos(bearings) * sx + np.sin(bearings) * sy
        valid = np.isfinite(scan.ranges) & (rise < -0.03)  # minimum fall, in metres per metre
        ranges, rise, bearings = scan.ranges[valid], rise[valid], bearings[valid]
        heights = mount.z + ranges * rise
        # 0.10: maximum height of a beam's end above the robot's own level for a ground hit, m
        hit = np.flatnonzero(abs(heights) < 0.10)
        # 60: maximum number of points per scan: the fit of planes stays well below a millisecond
        hit = hit[:: max(math.ceil(len(hit) / 60), 1)]
        level = ranges[hit] * np.sqrt(1.0 - rise[hit] ** 2)
        local = np.column_stack((level * np.cos(bearings[hit]), level * np.sin(bearings[hit])))
        in_frame = _placed(_placed(local, np.array(mount.planar)), pose)
        self._hits.append((scan.stamp, np.column_stack((in_frame, heights[hit] + self._height))))

    def _fit(self, now: int) -> None:
        # 3 * SECOND: time over which such points are combined, ns; the robot's height is integrated from its pitch and
        # drifts
        while self._hits and self._hits[0][0] < now - 3 * SECOND:
            self._hits.popleft()
        if self._hits:
            points, tilt, roughness = planes(np.vstack([hits for _, hits in self._hits]))
            self._grid.observe(points, tilt, roughness)
            self._changed |= len(points) > 0

    def _publish(self, now: int) -> None:
        self._changed = False
        pose = self._pose.latest
        if pose is not None and not self._grid.empty:
            self._out.put(self._grid.message(now, self._out.next_seq(), pose.frame))

    async def _keep(self) -> None:
        if self._save is None or self._grid.empty:
            return
        folder, run = self._save
        try:
            await self._offload(lambda: self._grid.save(folder, run))
        except OSError as error:
            self._events(disk_reason(error), Severity.WARNING, self.name, f"ground not saved: {error}")


def _spread(length: float, width: float) -> Array:
    """Return points over a rectangle around the origin, at least one in each cell, (n, 2)."""
    xs, ys = (np.linspace(-v / 2, v / 2, math.ceil(2 * v / GROUND_RESOLUTION) + 1) for v in (length, width))
    grid: Any = np.meshgrid(xs, ys)
    return np.asarray(np.stack(grid, axis=-1).reshape(-1, 2))


def _placed(points: Array, pose: Array) -> Array:
    """Transform points (n, 2) from the frame at ``pose``, (3,), into the frame of the pose."""
    c, s = math.cos(pose[2]), math.sin(pose[2])
    return np.asarray(points @ np.array(((c, s), (-s, c))) + pose[:2])
