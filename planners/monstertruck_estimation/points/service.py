"""Points of interest service: sends images to the reading worker, and turns its readings into map objects.

It also publishes the poses of the tags in each image. While the robot docks, it reads every image, even at standstill
or without a pose in the map.
"""

import asyncio
import base64
import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from monstertruck_estimation.points import files
from monstertruck_estimation.points.config import PointsConfig
from monstertruck_estimation.points.exchange import ReadAnswer, ReadTask, tag_pose
from monstertruck_estimation.points.tracking import Bases, PointMap, PoseAsker, nearest
from monstertruck_kinematics.elementary import Array
from monstertruck_kinematics.se2 import Pose2, between, compose
from monstertruck_runtime.actors.actor import Actor
from monstertruck_runtime.clock import SECOND, Clock, Schedule
from monstertruck_runtime.errors import InputError, NotFoundError, RequestRefusedError, WorkerError, disk_reason
from monstertruck_runtime.mailbox import Mailbox
from monstertruck_runtime.map_folders import holds_map
from monstertruck_runtime.ports import EventSink, Publisher, Ready, RpcRegistry, Subscription
from monstertruck_runtime.requests import Sequences, examine, parse_request
from monstertruck_runtime.threads import Offload
from monstertruck_schemas.body import LensConfig, Mount
from monstertruck_schemas.event import Severity
from monstertruck_schemas.health import NO_PLACE, SlamHealth
from monstertruck_schemas.plan import DOCK, BehaviourState
from monstertruck_schemas.points import PointOrder, PointRequest, PointsOfInterest, TagPoses
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.roles import AccessRole, ServiceName
from monstertruck_schemas.sensor import Attitude, CompressedImage
from monstertruck_schemas.state import GateState, Odometry
from monstertruck_schemas.topics import POSE

TARGET: Final = "monstertruck_estimation.points.reader:ReadingStep"
READER_START_TIMEOUT: Final = 60.0
"""Time that the worker may take to start (real seconds)."""
OLDEST: Final = SECOND
"""Maximum age of an image that is read (ns)."""
PERIOD: Final = SECOND
"""Time between two messages (ns)."""
OTHERS_PAUSE: Final = 0.02
"""Pause that lets other tasks on the event loop run (s)."""


@dataclass(frozen=True, slots=True)
class PointInputs:
    """Topics that the service reads."""

    camera: Mailbox[CompressedImage] | None
    """Camera images; None if only operators mark places."""
    pose: Mailbox[Odometry]
    """All poses of the robot in map."""
    slam: Subscription[SlamHealth] | None
    attitude: Subscription[Attitude] | None
    gate: Subscription[GateState]
    behaviour: Subscription[BehaviourState] | None = None


@dataclass(frozen=True, slots=True)
class PointFolders:
    """Folders for points."""

    load: Path | None = None
    """Folder of the map known at the start."""
    save: Path | None = None
    run: str | None = None
    """Run that makes the map; None for a known map."""


@dataclass(frozen=True, slots=True)
class _Placed:
    stamp: int
    pose: Pose2
    covariance: Array
    rate: float


class PointService:
    """Find tags in the camera's images, and keep them and the operators' marks on the map.

    Args:
        config: gates and rates.
        camera: mount and lens; None without a camera.
        clock: the service's clock.
        actor: runs the image reader.
        inputs: topics read.
        ask: returns past poses of the robot; None if the map never moves.
        out: publisher of ``state/points``.
        tags: publisher of ``state/tags``.
        events: sink of finds and failures.
        folders: folders of the map.
        save_map: requests a save of this run's map as soon as possible; None for a known map.
        offload: runs file access outside the event loop.
        max_age: see ``GateConfig.max_request_age``.
    """

    name = ServiceName.POINTS.value

    def __init__(
        self,
        config: PointsConfig,
        camera: tuple[Mount, LensConfig] | None,
        clock: Clock,
        actor: Actor,
        *,
        inputs: PointInputs,
        ask: PoseAsker | None,
        out: Publisher[PointsOfInterest],
        tags: Publisher[TagPoses],
        events: EventSink,
        folders: PointFolders,
        save_map: Callable[[], object] | None,
        offload: Offload,
        max_age: float,
    ) -> None:
        self._config, self._clock, self._actor, self._in = config, clock, actor, inputs
        mount, self._lens = self._mount, _ = (Mount(), LensConfig()) if camera is None else camera
        self._tags = tags
        self._ask, self._out, self._events, self._folders = ask, out, events, folders
        self._save_map, self._offload = save_map, offload
        self._map_saved = False
        """Whether the map of this run has been saved."""
        self._map = PointMap(config, mount)
        self._sequences = Sequences(max_age)
        self._history: deque[_Placed] = deque(maxlen=128)  # maximum number of stored poses: 2.5 s at 50 Hz
        self._trail: deque[tuple[int, Pose2]] = deque(maxlen=4000)
        self._stamps: tuple[int, ...] = ()
        self._bases: Bases = {}
        self._dirty: dict[str, None] = {}
        self._published = self._unsaved = False
        self._looked: tuple[Pose2, int] | None = None
        """Place of the last images and their number."""
        self._unreadable = False
        self._writing = asyncio.Lock()
        self._unanchored: dict[str, int] = {}
        """Stamps of marks with a place in the map, but without the robot's pose then in the current map."""

    async def run(self, ready: Ready) -> None:
        """Serve until cancelled, then save."""
        await self._load()
        try:
            async with self._actor as actor, asyncio.TaskGroup() as tasks:
                if self._in.camera is not None:
                    tasks.create_task(self._look(actor, self._in.camera))
                tasks.create_task(self._keep())
                ready()
        finally:
            for name in self._dirty:
                self._map.refresh(name, self._bases)
            await self._save()

    # Images

    async def _look(self, actor: Actor, camera: Mailbox[CompressedImage]) -> None:
        schedule, newest = Schedule(self._clock, self._config.rate), 0
        while True:
            await schedule.next()
            picture = camera.latest
            if picture is None or picture.stamp <= newest or self._clock.now() - picture.received > OLDEST:
                continue
            newest = picture.stamp
            placed = await self._placed(picture.stamp)
            useful = placed is not None and self._is_level() and self._worth(placed.pose)
            if not (useful or self._docks()):
                continue
            try:
                answer: ReadAnswer = await actor.step(ReadTask.of(picture.data, self._lens, self._config))
            except WorkerError as error:
                self._events(error.reason, Severity.ERROR, self.name, str(error))
                await self._clock.sleep(2.0)  # pause before a failed worker restarts, s
                continue
            self._publish_tags(answer, picture)
            if useful and placed is not None:
                self._take(answer, placed)

    def _docks(self) -> bool:
        behaviour = None if self._in.behaviour is None else self._in.behaviour.latest
        return behaviour is not None and behaviour.running and behaviour.kind == DOCK

    def _publish_tags(self, answer: ReadAnswer, picture: CompressedImage) -> None:
        tags = tuple(tag_pose(reading, self._mount) for reading in answer.readings)
        seq = self._tags.next_seq()
        self._tags.put(TagPoses(stamp=picture.stamp, received=self._clock.now(), seq=seq, frame="base", tags=tags))

    def _take(self, answer: ReadAnswer, placed: _Placed) -> None:
        if answer.unreadable and not self._unreadable:
            self._events(Reason.BAD_INPUT, Severity.WARNING, self.name, "an image of the camera cannot be decoded")
        self._unreadable = answer.unreadable
        for reading in answer.readings:
            found = self._map.see(reading, placed.stamp, placed.pose, placed.covariance, placed.rate)
            name = f"tag-{reading.tag}"
            self._dirty[name] = None
            if found:
                self._map.refresh(name, self._bases)
                point = self._map.shown[name]
                text = f"{name} at ({point.x:.2f}, {point.y:.2f})"
                self._events(Reason.POINT_FOUND, Severity.INFO, self.name, text, tag=reading.tag)
        if answer.readings:
            self._stamps = self._map.stamps()

    async def _placed(self, stamp: int) -> _Placed | None:
        """Return the robot's pose at an instant; None if unknown."""
        limit = self._clock.now() + (SECOND // 10)  # maximum wait of an image for a pose at its stamp, ns
        self._gather()
        while (not self._history or self._history[-1].stamp < stamp) and self._clock.now() < limit:
            await self._clock.sleep(OTHERS_PAUSE)
            self._gather()
        if self._is_lost():
            return None
        rows = list(self._history)
        after = next((i for i, row in enumerate(rows) if row.stamp >= stamp), None)
        if after is None or after == 0:
            return None
        a, b = rows[after - 1], rows[after]
        share = (stamp - a.stamp) / max(b.stamp - a.stamp, 1)
        way = between(np.array(a.pose), np.array(b.pose)) * share
        x, y, yaw = compose(np.array(a.pose), way).tolist()
        return _Placed(stamp, (x, y, yaw), b.covariance, b.rate)

    def _gather(self) -> None:
        for message in self._in.pose.drain():
            pose = (message.pose.x, message.pose.y, message.pose.yaw)
            if self._history and message.stamp <= self._history[-1].stamp:
                self._history.clear()
            covariance = message.pose_covariance.reshape(3, 3)
            self._history.append(_Placed(message.stamp, pose, covariance, message.twist.wz))
            # 0.5: distance between stored places for marks, m
            if not self._trail or math.dist(self._trail[-1][1][:2], pose[:2]) >= 0.5:
                self._trail.append((message.stamp, pose))

    def _is_lost(self) -> bool:
        slam = None if self._in.slam is None else self._in.slam.latest
        return slam is not None and slam.standing in NO_PLACE

    def _is_level(self) -> bool:
        attitude = None if self._in.attitude is None else self._in.attitude.latest
        return attitude is None or not attitude.tilt_valid or math.hypot(
            attitude.pitch, attitude.roll
        ) <= self._config.tilt  # fmt: skip

    def _worth(self, pose: Pose2) -> bool:
        """Whether the robot has moved since the last images, or has read only one image at this place."""
        # maximum motion (m, rad) of a robot still at the place of the last image
        standing = (0.02, 0.02)
        if self._looked is not None:
            before, looks = self._looked
            turned = abs(math.remainder(pose[2] - before[2], math.tau))
            if math.dist(before[:2], pose[:2]) < standing[0] and turned < standing[1]:
                self._looked = before, looks + 1
                return looks < 2  # number of images per place
        self._looked = pose, 1
        return True

    # Storage

    async def _keep(self) -> None:
        schedule = Schedule(self._clock, 2.0)  # checks for changes, 1/s
        now = self._clock.now()
        published, saved = now - PERIOD, now
        while True:
            await schedule.next()
            self._gather()
            self._correct()
            await self._refresh()
            now = self._clock.now()
            if not self._published and now - published >= PERIOD:
                published, self._published = now, True
                self._publish(now)
            if self._unsaved and now - saved >= 10 * SECOND:  # interval between writes of the file, ns
                saved, self._unsaved = now, False
                if await self._save() is not Reason.OK:
                    self._unsaved = True

    def _correct(self) -> None:
        """Move the points according to the mapper's corrections."""
        if self._ask is None or not self._stamps:
            return
        bases = self._ask(self._stamps)
        if bases is self._bases:
            return
        before, self._bases = self._bases, bases
        new = {at for at, base in bases.items() if at not in before or _apart(before[at], base)}
        for name in [name for name, at in self._unanchored.items() if at in bases]:
            del self._unanchored[name]
            self._map.anchor(name, bases[self._map.points[name].sightings[0].stamp])
        if new:
            points = self._map.points.values()
            self._dirty |= {p.name: None for p in points if any(one.stamp in new for one in p.sightings)}

    async def _refresh(self) -> None:
        dirty, self._dirty = list(self._dirty), {}
        for i, name in enumerate(dirty):
            if i and i % 4 == 0:  # number of computed points before other tasks run
                await self._clock.sleep(OTHERS_PAUSE)
            self._map.refresh(name, self._bases)
        if dirty:
            self._published, self._unsaved = False, True

    def _publish(self, now: int) -> None:
        points = tuple(self._map.shown.values())
        self._out.put(PointsOfInterest(stamp=now, received=now, seq=self._out.next_seq(), frame="map", points=points))

    async def _load(self) -> None:
        if (folder := self._folders.load) is None:
            return
        try:
            self._map.load(await self._offload(lambda: files.load(folder)))
        except InputError as error:
            self._events(
                Reason.FILE_DAMAGED, Severity.WARNING, self.name, f"{error}; points are not saved over this file"
            )
            if folder == self._folders.save:
                self._folders = PointFolders(folder)
        self._dirty = dict.fromkeys(self._map.points)

    async def _save(self) -> Reason:
        """Save the points with the map; return ``OK``, or the reason of the failure."""
        folder, run = self._folders.save, self._folders.run
        if folder is None:
            return Reason.OK
        async with self._writing:
            rows = self._map.pictured()
            try:
                await self._offload(lambda: files.save(folder, rows, run))
            except (OSError, InputError) as error:
                reason = disk_reason(error) if isinstance(error, OSError) else error.reason
                self._events(reason, Severity.WARNING, self.name, f"points not saved: {error}")
                return reason
        return Reason.OK

    # Requests

    async def kept(self) -> None:
        """Save the current points with their map: an answered request must survive a power cut.

        Raises:
            RequestRefusedError: the points cannot be written, or the map is not saved in time; the service tries again.
        """
        await self._refresh()
        reason = await self._save()
        self._unsaved = reason is not Reason.OK
        if self._unsaved:
            text = f"done, but a power cut would undo it: {reason.text}; the robot keeps trying to save it"
            raise RequestRefusedError(reason, text)
        await self._require_map()

    async def _require_map(self) -> None:
        """Request a save of this run's map unless it is saved: points must not join the map of another run.

        Raises:
            RequestRefusedError: the map is not saved in time.
        """
        folder, run = self._folders.save, self._folders.run
        if folder is None or run is None or self._save_map is None or self._map_saved:
            return
        self._save_map()
        try:
            async with self._clock.deadline(4.0):  # maximum duration of a call: 5 s
                while not await self._offload(lambda: holds_map(folder, run)):
                    await self._clock.sleep(0.1)
        except TimeoutError:
            text = "done, but a power cut would undo it: the map is not saved yet; the robot keeps trying"
            raise RequestRefusedError(Reason.NO_MAP, text) from None
        self._map_saved = True

    def take(self, request: PointRequest) -> Pose2 | None:
        """Mark a place, or forget a point.

        Returns:
            The marked place: x, y, yaw in map.

        Raises:
            RequestRefusedError: the sender lacks permission, or the robot does not know its pose.
            NotFoundError: no point has this name.
            InputError: the place is incomplete.
        """
        examine(request, self._in.gate.latest, self._sequences, self._clock.now(), None)
        place = None
        if request.order is PointOrder.REMOVE:
            if self._map.points.pop(request.name, None) is None:
                names = ", ".join(sorted(self._map.points))
                known = f"expected one of {names}" if names else "none is known"
                raise NotFoundError(f"no point of interest {request.name!r}: {known}")
            self._unanchored.pop(request.name, None)
            text = f"{request.name} removed by {request.source}"
        else:
            place = self._mark(request)
            text = f"{request.name} at ({place[0]:.2f}, {place[1]:.2f}), marked by {request.source}"
        self._dirty[request.name] = None
        self._stamps = self._map.stamps()
        self._events(Reason.POINT_CHANGED, Severity.INFO, self.name, text)
        return place

    def _mark(self, request: PointRequest) -> Pose2:
        if (request.x is None) != (request.y is None):
            raise InputError("point: x and y: expected both, or neither")
        if request.name.startswith("tag-"):
            raise InputError(f"point {request.name!r}: names starting with tag- are reserved for tags")
        if request.name not in self._map.points and len(self._map.points) >= self._config.most:
            raise InputError(f"point: the maximum of {self._config.most} points is reached; remove one first")
        self._gather()
        fresh = self._history and self._clock.now() - self._history[-1].stamp <= POSE.fresh_for() * SECOND
        if not fresh:
            raise RequestRefusedError(Reason.NO_MAP, "no fresh pose in map")
        if request.x is None and self._is_lost():
            raise RequestRefusedError(Reason.POSE_LOST, "the robot's pose in the map is unknown")
        here = self._history[-1]
        x, y, yaw = here.pose
        place = (
            x if request.x is None else request.x,
            y if request.y is None else request.y,
            yaw if request.yaw is None else math.remainder(request.yaw, math.tau),
        )
        # A distant place moves with the nearest part of the map.
        stamp, base = (here.stamp, here.pose) if request.x is None else nearest(self._trail, place)
        self._unanchored.pop(request.name, None)
        if request.x is not None and self._ask is not None and stamp not in self._bases:
            self._unanchored[request.name] = stamp
        base = self._bases.get(stamp, base)
        self._map.mark(request.name, stamp, base, place, here.covariance)
        return place

    def picture(self, name: str) -> bytes:
        """Return the image of a point (JPEG).

        Raises:
            NotFoundError: the point does not exist, or has no image.
        """
        tracked = self._map.points.get(name)
        if tracked is None or not tracked.picture:
            raise NotFoundError(f"no image of a point of interest {name!r}")
        return tracked.picture

    def register(self, rpc: RpcRegistry) -> None:
        """Serve ``points``, which answers a mark with its place, and ``point_picture``, which takes a ``name``."""

        async def points(payload: dict[str, Any]) -> dict[str, Any]:
            place = self.take(parse_request(PointRequest, payload))
            await self.kept()
            return {} if place is None else dict(zip(("x", "y", "yaw"), place, strict=True))

        async def point_picture(payload: dict[str, Any]) -> dict[str, Any]:
            data = self.picture(str(payload.get("name", "")))
            return {"jpeg": base64.b64encode(data).decode("ascii")}

        rpc.register("points", points)
        rpc.register("point_picture", point_picture, AccessRole.OBSERVER, recorded=False)


def _apart(one: Pose2, other: Pose2) -> bool:
    # 0.001: minimum correction (m, rad) that moves a point
    return max(abs(one[0] - other[0]), abs(one[1] - other[1]), abs(math.remainder(one[2] - other[2], math.tau))) > 0.001
