"""SLAM in the daemon: sends scans to the worker, publishes pose, map, scan motion and health."""

import asyncio
from bisect import bisect_left
from collections import deque
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np

from monstertruck_estimation.correction import SmoothedCorrection
from monstertruck_estimation.scan_tilt import ScanAngles, plane_slopes
from monstertruck_estimation.slam.config import SlamConfig
from monstertruck_estimation.slam.worker_io import (
    GridPatch,
    ScanIncrement,
    ScanInput,
    SlamEstimate,
    Start,
    WorkerInput,
    WorkerOutput,
)
from monstertruck_estimation.transforms import planar
from monstertruck_kinematics.elementary import Array
from monstertruck_kinematics.se2 import Pose2, Twist2, between, interpolate, rotation
from monstertruck_runtime.actors.actor import WorkerActor
from monstertruck_runtime.clock import SECOND, Clock
from monstertruck_runtime.errors import DamagedFileError, WorkerError
from monstertruck_runtime.mailbox import Mailbox
from monstertruck_runtime.ports import EventSink, Publisher, Ready, Subscription
from monstertruck_schemas.base import Pose2D, Twist2D
from monstertruck_schemas.body import Mount
from monstertruck_schemas.event import Severity
from monstertruck_schemas.health import MATCHED, PLACELESS, LocalisationStatus, OdometryUse, SlamHealth
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.roles import ServiceName
from monstertruck_schemas.sensor import LaserScan
from monstertruck_schemas.state import Grid, Odometry, ScanMotion, Transform

TARGET: Final = "monstertruck_estimation.slam.worker:SlamWorker"
UNMATCHED: Final = SECOND
"""Maximum time without a usable scan (ns); then odometry alone predicts the pose, without the lidar as source."""
CORRECTIONS: Final = {
    "closed": (Reason.LOOP_CLOSED, Severity.INFO, "closure {}"),
    "joined": (Reason.LOOP_CLOSED, Severity.INFO, "two submaps are joined"),
    "changed": (Reason.MAP_CHANGED, Severity.WARNING, "another floor, or walls have moved: save a map of its own"),
    "parted": (Reason.JOIN_UNDONE, Severity.WARNING, "later scans contradict it"),
}
"""Event text of a step that has corrected the map; {} is the number of closures."""


@dataclass(frozen=True, slots=True)
class OtherLidar:
    """Second lidar: its scans extend the map; only those of the first lidar are matched."""

    mount: Mount
    scan: Subscription[LaserScan]
    angles: ScanAngles | None
    """Body and mount angles, as for the first lidar."""


class SlamService:
    """Send every scan to the worker with odometry at its stamp; between scans the pose follows odometry.

    Args:
        config: settings of mapping, and folders of the map.
        mount: mount of the lidar.
        body: length and width of the robot (m).
        run: this run, for saved maps.
        clock: the service's clock.
        scan: scans of the lidar from a bounded, counted queue.
        odometry: pose in odom; without it (None) the pose is published once per scan.
        angles: angles of body and mount at the time of scans, for removing hits of the ground; None without a compass.
        other: the second lidar; None without one.
        pose: publisher of ``state/pose``.
        whole: publisher of ``state/map``.
        tiles: publisher of ``state/map_tiles``.
        motion: publisher of ``state/scan_motion``.
        health: publisher of ``health/slam``.
        events: sink of closures, losses and unusable scans.
    """

    name = ServiceName.SLAM.value

    def __init__(
        self,
        config: SlamConfig,
        mount: Mount,
        clock: Clock,
        *,
        body: tuple[float, float] | None = None,
        run: str = "",
        scan: Mailbox[LaserScan],
        odometry: Mailbox[Odometry] | None,
        angles: ScanAngles | None,
        other: OtherLidar | None = None,
        pose: Publisher[Odometry],
        whole: Publisher[Grid],
        tiles: Publisher[Grid],
        motion: Publisher[ScanMotion],
        health: Publisher[SlamHealth],
        events: EventSink,
    ) -> None:
        self._config, self._mount, self._body, self._run, self._clock = config, mount, body, run, clock
        self._scan, self._odometry, self._angles = scan, odometry, angles
        self._other = other
        self._other_sent: LaserScan | None = None
        self._motions = motion
        self._pose, self._whole, self._tiles, self._health, self._events = pose, whole, tiles, health, events
        self._history: deque[tuple[int, Pose2]] = deque(maxlen=128)  # number of stored odometry poses: 2.5 s at 50 Hz
        self._correction = SmoothedCorrection(config.slew, config.jump)
        self._newest: SlamEstimate | None = None
        self._latest: Odometry | None = None
        self._matched_at: Odometry | None = None
        """Odometry at the latest estimate."""
        self._status: LocalisationStatus | None = None
        self._degenerate_said: int | None = None
        self._use = OdometryUse.NONE
        self._refused: str | None = None
        self._left_out = 0
        self._offset_reported = False
        self._mount_reported = False
        self._due = {"tiles": 0, "whole": 0, "save": clock.now() + round(config.save_period * SECOND)}
        self._changed = False
        self._under_way: asyncio.Task[Any] | None = None
        self._one_step = asyncio.Lock()
        self._asked = asyncio.Event()
        """Set when the map must be saved."""
        self._started = False
        """Whether the worker has a map."""
        self._instants: tuple[int, ...] = ()
        self._sent_instants: tuple[int, ...] = ()
        self._bases: dict[int, Pose2] = {}

    def frames(self) -> Iterable[Transform]:
        """Return the published pose of odom in map; without odometry, of base in map."""
        if self._odometry is not None:
            stamp = self._history[-1][0] if self._history else 1
            return (planar("map", "odom", stamp, self._correction.value),)
        if self._newest is None:
            return ()
        stamp = self._newest.stamp
        return planar("map", "odom", stamp, self._newest.pose), planar("odom", "base", stamp, (0.0, 0.0, 0.0))

    def bases_at(self, instants: tuple[int, ...]) -> Mapping[int, Pose2]:
        """Return the poses of base at several stamps (ns) in the current graph; updated every ``tiles_period``.

        Stamps requested now are answered later; stamps unknown to the map are never answered.
        """
        self._instants = instants
        return self._bases

    def save_soon(self) -> bool:
        """Save the map at the next scan; return whether there is a map and a folder for it."""
        self._due["save"] = 0
        self._asked.set()
        return self._config.save is not None and self._config.mode == "mapping"

    async def run(self, ready: Ready) -> None:
        """Send scans to the worker until cancelled, then save the map.

        Raises:
            WorkerError: the worker failed, hung or died; the next session starts a new map at the robot's current
                place.
            DamagedFileError: the saved map cannot be read.
        """
        config = self._config
        start_timeout = 180.0  # maximum start time of the worker, s of real time: numba compiles at the first start
        worker = WorkerActor(
            self.name,
            TARGET,
            self._clock,
            latency=config.latency,
            deadline=config.deadline,
            start_timeout=start_timeout,
        )
        async with worker:
            await worker.start()
            self._started = False
            ready()
            try:
                async with asyncio.TaskGroup() as tasks:
                    tasks.create_task(self._map(worker))
                    tasks.create_task(self._save_unscanned(worker))
                    if self._odometry is not None:
                        tasks.create_task(self._follow(self._odometry))
            except* (WorkerError, DamagedFileError) as group:
                raise group.exceptions[0] from None
            finally:
                await self._end(worker)

    # Pose

    async def _follow(self, odometry: Mailbox[Odometry]) -> None:
        async for message in odometry:
            before = self._history[-1][0] if self._history else message.stamp
            if message.stamp < before:
                self._history.clear()
                before = message.stamp
            odom = (message.pose.x, message.pose.y, message.pose.yaw)
            self._history.append((message.stamp, odom))
            x, y, yaw = self._correction.pose(odom, (message.stamp - before) / SECOND)
            update: dict[str, Any] = {
                "frame": "map",
                "seq": self._pose.next_seq(),
                "pose": Pose2D(x=x, y=y, yaw=yaw),
            }
            if self._newest is not None:
                known = np.array(self._newest.covariance)
                if message.stamp - self._newest.stamp <= UNMATCHED:
                    update["sources"] = (*message.sources, "lidar")
                elif self._matched_at is not None:
                    known = carried_on(known, self._matched_at, message, self._correction.value[2])
                update["pose_covariance"] = known
            self._latest = message
            self._pose.put(message.model_copy(update=update))

    def _publish_pose(self, estimate: SlamEstimate, scan: LaserScan) -> None:
        """Publish the pose of a robot without odometry."""
        x, y, yaw = estimate.pose
        self._pose.put(
            Odometry(
                stamp=estimate.stamp,
                received=self._clock.now(),
                seq=self._pose.next_seq(),
                frame="map",
                pose=Pose2D(x=x, y=y, yaw=yaw),
                twist=Twist2D(vx=0.0, vy=0.0, wz=0.0),
                pose_covariance=np.array(estimate.covariance),
                twist_covariance=np.zeros(9),
                age=max((self._clock.now() - scan.stamp) / SECOND, 0.0),
                sources=("lidar",),
            )
        )

    # Scans

    async def _map(self, worker: WorkerActor) -> None:
        async for scan in self._scan:
            reason = self._unusable(scan)
            if reason is not None:
                self._skip(reason)
                continue
            inputs = self._inputs(scan, self._mount, self._angles)
            start = None if self._started else Start(self._config, self._start(inputs.odom), self._body, self._run)
            async with self._one_step:
                outputs = await self._step(worker, self._work(inputs, start))
            if outputs.unreadable is not None:
                raise DamagedFileError(outputs.unreadable)
            self._started = True
            self._take(outputs, scan)

    async def _save_unscanned(self, worker: WorkerActor) -> None:
        """Save a requested map although there is no usable scan."""
        while True:
            await self._asked.wait()
            self._asked.clear()
            # Maximum wait for a usable scan before a requested save, s; then the map is saved without one.
            unscanned = 1.0
            await self._clock.sleep(unscanned)
            async with self._one_step:
                if self._started and self._due["save"] == 0 and self._config.mode == "mapping":
                    self._due["save"] = self._clock.now() + round(self._config.save_period * SECOND)
                    self._report_saved(await self._step(worker, WorkerInput(save=self._config.save)))

    async def _step(self, worker: WorkerActor, work: WorkerInput) -> WorkerOutput:
        """Run a step shielded from cancellation, which would kill the worker and lose the map before its save."""
        self._under_way = asyncio.ensure_future(worker.step(work))
        outputs: WorkerOutput = await asyncio.shield(self._under_way)
        return outputs

    async def _end(self, worker: WorkerActor) -> None:
        task, self._under_way = self._under_way, None
        if task is None or worker.pid is None:
            return
        if not task.done():
            await task
        if self._config.save is not None and self._config.mode == "mapping" and task.exception() is None:
            # Save the map as it is first: the joint registration takes seconds that may not be available.
            self._report_saved(await worker.step(WorkerInput(save=self._config.save)))
            self._report_saved(await worker.step(WorkerInput(save=self._config.save, finish=True)))

    def _unusable(self, scan: LaserScan) -> str | None:
        if scan.tilt is not None and scan.tilt > self._config.max_tilt:
            return f"tilted by {scan.tilt:.2f} rad, expected at most {self._config.max_tilt:g}"
        if self._odometry is not None and not self._history:
            return "no odometry yet"
        return None

    def _of_other(self) -> ScanInput | None:
        """Return the latest scan of the second lidar unless it was sent already."""
        other = self._other
        scan = None if other is None else other.scan.latest
        if other is None or scan is None or scan is self._other_sent or self._unusable(scan) is not None:
            return None
        self._other_sent = scan
        return self._inputs(scan, other.mount, other.angles)

    def _inputs(self, scan: LaserScan, mount: Mount, angles: ScanAngles | None) -> ScanInput:
        odom, twist = self._motion(scan.stamp, scan.stamp + round(scan.time_increment * len(scan.ranges) * SECOND))
        tilts = None if angles is None else angles.at(scan)
        height = mount.z if mount.z > 0 else None
        return replace(
            ScanInput.of(scan, mount.planar),
            odom=odom,
            twist=twist,
            slopes=None if tilts is None else plane_slopes(*tilts, yaw=mount.yaw),
            height=height,
            ceiling=self._config.ceiling,
        )

    def _motion(self, begin: int, end: int) -> tuple[Pose2 | None, Twist2]:
        """Return base in odom at ``begin``, and the velocity until ``end``; both in ns."""
        history = self._history
        stale = SECOND // 5  # maximum lag of odometry behind the scan, ns
        if not history or begin - history[-1][0] > stale or begin < history[0][0]:
            return None, (0.0, 0.0, 0.0)
        first = max(bisect_left(history, begin, key=lambda row: row[0]) - 1, 0)
        rows = list(history)[first:]
        stamps = np.array([row[0] - begin for row in rows], np.float64)
        until = min(end - begin, stamps[-1])
        poses = interpolate(stamps, np.array([row[1] for row in rows]), np.array((0.0, until)))
        x, y, yaw = poses[0].tolist()
        if until <= 0:
            return (x, y, yaw), (0.0, 0.0, 0.0)
        vx, vy, wz = (between(poses[0], poses[1]) / (until / SECOND)).tolist()
        return (x, y, yaw), (vx, vy, wz)

    def _start(self, odom: Pose2 | None) -> Pose2:
        """Return the initial pose of a new map: the current pose in map."""
        if odom is not None:
            return self._correction.pose(odom, 0.0)
        return (0.0, 0.0, 0.0) if self._newest is None else self._newest.pose

    # Output of the worker

    def _work(self, scan: ScanInput, start: Start | None) -> WorkerInput:
        config, now = self._config, self._clock.now()
        due = {name for name, at in self._due.items() if now >= at}
        whole = start is not None or ("whole" in due and self._changed)
        if whole:
            due.add("tiles")
            self._due["whole"] = now + round(config.map_period * SECOND)
            self._changed = False
        if "tiles" in due:
            self._due["tiles"] = now + round(config.tiles_period * SECOND)
        save = config.save if "save" in due and config.mode == "mapping" else None
        if "save" in due:
            self._due["save"] = now + round(config.save_period * SECOND)
        self._sent_instants = self._instants if "tiles" in due else ()
        return WorkerInput(
            start=start,
            scan=scan,
            other=self._of_other(),
            tiles="tiles" in due,
            whole=whole,
            save=save,
            instants=self._sent_instants,
        )

    def _take(self, outputs: WorkerOutput, scan: LaserScan) -> None:
        if outputs.refused is not None:
            self._skip(outputs.refused)
        self._report_saved(outputs)
        for remark in outputs.remarks:
            self._events(Reason.FILE_DAMAGED, Severity.WARNING, self.name, remark)
        if outputs.bases is not None:
            rows = zip(self._sent_instants, outputs.bases.tolist(), strict=True)
            self._bases = {at: (x, y, yaw) for at, (x, y, yaw) in rows if x == x}  # NaN: unknown
        now = self._clock.now()
        self._changed |= bool(outputs.tiles)
        if outputs.whole is not None and outputs.whole.cells.size:
            self._whole.put(grid_message(outputs.whole, now, self._whole.next_seq()))
        else:
            for tile in outputs.tiles:
                self._tiles.put(grid_message(tile, now, self._tiles.next_seq()))
        estimate = outputs.estimate
        if estimate is None:
            return
        self._refused = None
        found = self._status is not None and self._status not in MATCHED and estimate.status in MATCHED
        at_once = found or self._newest is None or estimate.odometry is OdometryUse.CONTRADICTED
        if estimate.map_from_odom is not None and estimate.status not in PLACELESS:
            self._correction.set_target(estimate.map_from_odom, at_once=at_once)
        self._newest, self._matched_at = estimate, self._latest
        if estimate.moved is not None:
            self._motions.put(scan_motion(estimate.stamp, estimate.moved, now, self._motions.next_seq()))
        self._report(estimate, outputs)
        if self._odometry is None:
            self._publish_pose(estimate, scan)

    def _report(self, estimate: SlamEstimate, outputs: WorkerOutput) -> None:
        self._health.put(
            slam_health(
                estimate, outputs.counts, (self._left_out, self._scan.drops), self._clock.now(), self._health.next_seq()
            )
        )
        for reason, severity, text in (CORRECTIONS[event] for event in estimate.events if event in CORRECTIONS):
            self._events(reason, severity, self.name, text.format(outputs.counts["closures"]))
        if estimate.offset is not None and not self._offset_reported:
            self._offset_reported = True
            text = f"odometry runs {estimate.offset:+.2f} s ahead of the scans"
            self._events(Reason.TIME_OFFSET, Severity.WARNING, self.name, text, offset=estimate.offset)
        if estimate.mount_fault is not None and not self._mount_reported:
            self._mount_reported = True
            self._events(Reason.LIDAR_TURNED, Severity.WARNING, self.name, estimate.mount_fault)
        if estimate.odometry is not self._use:
            previous, self._use = self._use, estimate.odometry
            if estimate.odometry in {OdometryUse.CONTRADICTED, OdometryUse.MISSING}:
                self._events(Reason.ODOMETRY_DROPPED, Severity.WARNING, self.name, str(estimate.odometry))
            elif previous in {OdometryUse.CONTRADICTED, OdometryUse.MISSING}:
                self._events(Reason.ODOMETRY_RETURNED, Severity.INFO, self.name, str(estimate.odometry))
        if estimate.status is self._status:
            return
        before, self._status = self._status, estimate.status
        said, now = self._degenerate_said, self._clock.now()
        # Minimum time between two events about scans with an undetermined direction, ns: in a corridor such scans
        # alternate with others.
        quiet = 30 * SECOND
        if estimate.status is LocalisationStatus.DEGENERATE and (said is None or now - said >= quiet):
            self._degenerate_said = now
            text = f"along {estimate.direction:.2f} rad in map"
            self._events(Reason.MATCH_DEGENERATE, Severity.WARNING, self.name, text)
        if estimate.status is LocalisationStatus.OUTSIDE:
            self._events(Reason.OUTSIDE_MAP, Severity.WARNING, self.name, "the search continues")
        elif estimate.status not in MATCHED:
            text = "the pose found was wrong: searching again" if "refuted" in estimate.events else str(estimate.status)
            self._events(Reason.POSE_LOST, Severity.WARNING, self.name, text)
        elif before is not None and before not in MATCHED:
            self._events(Reason.POSE_FOUND, Severity.INFO, self.name, str(estimate.status))

    def _skip(self, why: str) -> None:
        self._left_out += 1
        kind = why.partition(" ")[0]
        if kind != self._refused:
            self._refused = kind
            self._events(Reason.SCAN_LEFT_OUT, Severity.WARNING, self.name, why)

    def _report_saved(self, outputs: WorkerOutput) -> None:
        if outputs.saved is not None:
            poses = {None: "", True: ", poses by joint registration", False: ", poses by the graph"}[outputs.joint]
            self._events(Reason.MAP_SAVED, Severity.INFO, self.name, f"{outputs.saved}{poses}")
        if outputs.error is not None:
            self._events(Reason.MAP_NOT_SAVED, Severity.WARNING, self.name, str(outputs.error))


def carried_on(covariance: Array, before: Odometry, now: Odometry, turn: float) -> Array:
    """Return the covariance, (9,), of a pose in map from ``before``, predicted by odometry until ``now``.

    Args:
        covariance: covariance at ``before``, (9,).
        before: odometry at the estimate.
        now: current odometry.
        turn: yaw of odom in map (rad).
    """
    way = np.array((now.pose.x - before.pose.x, now.pose.y - before.pose.y))
    swung, swing, turned = np.eye(3), np.eye(3), np.eye(3)
    swung[:2, 2] = -way[1], way[0]
    turned[:2, :2] = rotation(turn)
    swing[:2, 2] = turned[:2, :2] @ swung[:2, 2]
    gained = now.pose_covariance.reshape(3, 3) - swung @ before.pose_covariance.reshape(3, 3) @ swung.T
    sizes, axes = np.linalg.eigh((gained + gained.T) / 2)
    gained = (axes * np.maximum(sizes, 0.0)) @ axes.T  # a compass may have reduced the covariance
    found = swing @ covariance.reshape(3, 3) @ swing.T + turned @ gained @ turned.T
    return np.asarray(found.ravel())


def grid_message(patch: GridPatch, now: int, seq: int) -> Grid:
    """Return a patch of the map as a separate grid."""
    rows, columns = patch.cells.shape
    cells = np.ascontiguousarray(patch.cells).reshape(-1)
    cells.flags.writeable = False
    x, y = patch.origin
    return Grid(
        stamp=now,
        received=now,
        seq=seq,
        frame="map",
        resolution=patch.resolution,
        width=columns,
        height=rows,
        origin=Pose2D(x=x, y=y, yaw=0.0),
        cells=cells,
    )


def scan_motion(stamp: int, moved: ScanIncrement, now: int, seq: int) -> ScanMotion:
    """Return the motion of base between two scans as a message."""
    x, y, yaw = moved.motion
    return ScanMotion(
        stamp=stamp,
        received=now,
        seq=seq,
        frame="base",
        since=moved.since,
        motion=Pose2D(x=x, y=y, yaw=yaw),
        covariance=np.array(moved.covariance),
    )


def slam_health(
    estimate: SlamEstimate, counts: Mapping[str, int], lost: tuple[int, int], now: int, seq: int
) -> SlamHealth:
    """Return the match of the latest scan as a health message; ``lost`` is the number of dropped and unused scans."""
    return SlamHealth(
        stamp=estimate.stamp,
        received=now,
        seq=seq,
        frame="map",
        standing=estimate.status,
        accepted=estimate.verdict == "accepted",
        overlap=min(max(estimate.overlap, 0.0), 1.0),
        residual=estimate.residual,
        degeneracy=estimate.degeneracy,
        direction=estimate.direction,
        scans=counts["scans"],
        keys=counts["keys"],
        closures=counts["closures"],
        rejected=counts["rejected"],
        left_out=lost[0],
        drops=lost[1],
        offset=estimate.offset,
        odometry=estimate.odometry,
    )
