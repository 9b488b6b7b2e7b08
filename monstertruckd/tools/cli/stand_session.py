"""Sessions of ``monstertruckd stand``: live tracking, recorded tracking, pictures, prints."""

import asyncio
import csv
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from monstertruck_runtime.clock import Clock
from monstertruck_runtime.errors import InputError, NotFoundError, TruckError
from monstertruckd.tools.cli.output import remark

if TYPE_CHECKING:
    from monstertruck_schemas.sensor import StandPose
    from monstertruckd.tools.stand.config import OverheadConfig
    from monstertruckd.tools.stand.poses import RobotPose
    from monstertruckd.tools.stand.track import Stream


async def run(clock: Clock, config: "OverheadConfig", endpoint: str) -> None:
    """Track live, and publish to every robot that is there."""
    from monstertruckd.tools.stand.track import StandRun

    robots = {name: RobotLink(name, endpoint, clock, remark) for name in config.names}
    tasks = [asyncio.create_task(link.run(), name=f"robot {name}") for name, link in robots.items()]
    tracker = _tracker(config, clock.now())
    try:
        live = any(camera.source.kind != "file" for camera in config.cameras.values())
        put = partial(_publish, robots)
        remark(f"tracks {', '.join(robots)} with {len(config.cameras)} cameras")
        run = StandRun(tracker, _streams(config), config.rate, clock, put, remark, live=live, colours=config.colours)
        await run.run()
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.wait(tasks)


async def track(clock: Clock, config: "OverheadConfig", out: Path) -> int:
    """Poses from recorded pictures into a CSV; returns their number."""
    from monstertruckd.tools.stand.track import StandRun

    poses: list[RobotPose] = []
    tracker, streams = _tracker(config, 0), _streams(config)
    run = StandRun(tracker, streams, config.rate, clock, poses.append, remark, live=False, colours=config.colours)
    await run.run()
    with out.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(("stamp_ns", "robot", "x_m", "y_m", "yaw_rad", "sigma_m", "cameras"))
        for p in poses:
            numbers = (f"{v:.5f}" for v in (p.x, p.y, p.yaw, p.sigma))
            writer.writerow((p.stamp, p.robot, *numbers, " ".join(p.cameras)))
    return len(poses)


def snap(config: "OverheadConfig", name: str, folder: Path, count: int, every: float) -> None:
    """Take pictures with one camera.

    Raises:
        InputError: there is no such camera, or it sends too few.
    """
    import cv2

    from monstertruck_runtime.clock import SECOND, WallClock

    streams = _streams(config)
    if name not in streams:
        raise InputError(f"camera {name}: expected one of {', '.join(streams)}")
    folder.mkdir(parents=True, exist_ok=True)
    clock = WallClock()
    taken, due = 0, clock.now()
    for picture in streams[name]():
        if clock.now() < due:
            continue
        due = clock.now() + round(every * SECOND)
        cv2.imwrite(str(folder / f"{taken:04d}.png"), picture)
        taken += 1
        if taken == count:
            return
    raise InputError(f"camera {name} sent {taken} images: expected {count}")


def print_tags(out: Path, numbers: str, columns: int, rows: int) -> Iterator[Path]:
    """Write tags and board as PNGs.

    Raises:
        InputError: numbers that are none.
    """
    import cv2

    from monstertruck_estimation.vision.tags import dictionary, drawn

    tags = _numbers(numbers)
    out.mkdir(parents=True, exist_ok=True)
    for tag in tags:
        path = out / f"tag-{tag:03d}.png"
        cv2.imwrite(str(path), cv2.copyMakeBorder(drawn(tag, 800), 160, 160, 160, 160, cv2.BORDER_CONSTANT, value=255))
        yield path
    board = cv2.aruco.CharucoBoard((columns, rows), 0.04, 0.03, dictionary())
    path = out / f"board-{columns}x{rows}.png"
    cv2.imwrite(str(path), board.generateImage((columns * 200, rows * 200), marginSize=40))
    yield path


class RobotLink:
    """Link to one robot's daemon, whenever it runs; reports once that it is connected, or why not.

    Args:
        robot: its name.
        endpoint: where it listens.
        clock: clock of this computer.
        say: gets lines for people.
    """

    def __init__(self, robot: str, endpoint: str, clock: Clock, say: Callable[[str], object]) -> None:
        self._robot, self._endpoint, self._clock, self._say = robot, endpoint, clock, say
        self._said = ""
        self._client: Any = None
        self._ways: deque[int] = deque(maxlen=100)  # number of latest messages of a robot that determine its clock
        """Time of receipt by this clock minus the robot's stamp, of its latest messages, ns."""
        self._count = 0

    async def run(self) -> None:
        """Keep the link until cancelled."""
        from monstertruck_runtime.client import TruckClient
        from monstertruck_runtime.mailbox import latest
        from monstertruck_runtime.presence import GONE
        from monstertruck_schemas.topics import GATE

        while True:
            try:
                async with TruckClient(self._robot, self._endpoint, clock=self._clock) as client:
                    with client.subscribe(GATE, latest()) as gate:
                        self._client = client
                        try:
                            while (state := await gate.next_within(GONE)) is not None:
                                self._ways.append(self._clock.now() - state.stamp)
                                self._report("receives its poses")
                        finally:
                            self._client = None
                            self._ways.clear()
                    self._report("is silent or not running")
            except NotFoundError:
                self._report(f"no robot answers at {self._endpoint}")
            except TruckError as error:
                self._report(str(error))
            await self._clock.sleep(2.0)  # seconds before a missing robot is searched for again

    def _report(self, text: str) -> None:
        if text != self._said:
            self._said = text
            self._say(f"robot {self._robot}: {text}")

    def put(self, pose: "RobotPose") -> None:
        """Publish a pose by the robot's clock, if the robot is there."""
        if self._client is not None and self._ways:
            self._count += 1
            now, apart = self._clock.now(), clocks_apart(self._ways)
            self._client.publish_stand_pose(stand_pose(pose, now - apart, self._count, pose.stamp - apart))


def clocks_apart(ways: Iterable[int]) -> int:
    """Lag of the robot's clock behind this computer (ns): 0 on the same computer.

    The shortest of ``ways``, from the robot's stamps to their receipt, is taken as zero: a millisecond on a network.
    """
    least = min(ways)
    # 200_000_000: minimum difference between distinct clocks of robot and computer, ns; messages take less
    return 0 if abs(least) < 200_000_000 else least


def stand_pose(pose: "RobotPose", now: int, count: int, stamp: int) -> "StandPose":
    """The message of a pose; times by the robot's clock (ns)."""
    from monstertruck_schemas.base import Pose2D
    from monstertruck_schemas.sensor import StandPose

    return StandPose(
        stamp=stamp,
        received=now,
        seq=count,
        frame="map",
        pose=Pose2D(x=pose.x, y=pose.y, yaw=pose.yaw),
        observer="overhead",
        position_sigma=pose.sigma,
        heading_sigma=pose.heading_sigma,
    )


def _publish(robots: dict[str, RobotLink], pose: "RobotPose") -> None:
    robots[pose.robot].put(pose)


def _tracker(config: "OverheadConfig", now: int) -> Any:
    from monstertruckd.tools.stand.calibration import load
    from monstertruckd.tools.stand.tracking import StandTracker

    placed = load(config.calibration).placed()
    if missing := config.cameras.keys() - placed.keys():
        raise InputError(f"{config.calibration}: lacks {', '.join(sorted(missing))}: run `stand calibrate` again")
    return StandTracker({name: placed[name] for name in config.cameras}, config.robots, config.marks, now, config.blobs)


def _streams(config: "OverheadConfig") -> dict[str, "Stream"]:
    from monstertruckd.tools.stand.sources import stream

    return {
        name: partial(stream, camera.source, config.size, config.rate, colour=bool(config.colours))
        for name, camera in config.cameras.items()
    }


def _numbers(text: str) -> list[int]:
    found: list[int] = []
    try:
        for part in text.split(","):
            first, _, last = part.partition("-")
            numbers = range(int(first), int(last or first) + 1)
            if not numbers:
                raise ValueError(part)
            found += numbers
    except ValueError:
        raise InputError(f"tags {text!r}: expected numbers such as 0-3,100") from None
    if not all(0 <= tag <= 586 for tag in found):
        raise InputError(f"tags {text!r}: expected 0 to 586")
    return found
