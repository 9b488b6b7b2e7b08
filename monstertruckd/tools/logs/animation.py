"""Animation of a drive: the robot from above, its path, and the lidar or sonar echoes so far."""

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np
from PIL import Image, ImageDraw

from monstertruck_kinematics.elementary import Array
from monstertruck_kinematics.se2 import placed
from monstertruck_runtime.clock import SECOND
from monstertruck_runtime.errors import CommandFailedError, InputError, TruckError
from monstertruck_runtime.moving_picture import MovingPicture
from monstertruck_schemas.plan import Path as DrivePath
from monstertruck_schemas.sensor import LaserScan, SonarRanges
from monstertruck_schemas.state import Odometry, Transforms
from monstertruck_schemas.topics import ODOMETRY, PATH, POSE, SCAN, SONAR, TRANSFORMS
from monstertruckd.config.truck import Geometry
from monstertruckd.recorder.reader import LogReader, spare_log
from monstertruckd.tools.logs.geometry import recorded_geometry
from monstertruckd.tools.logs.messages import Progress
from monstertruckd.tools.logs.report.scan_map import PlacedScans

MOST_FRAMES: Final = 1500
COLOURS: Final = (
    (255, 255, 255),
    (70, 70, 80),
    (150, 180, 230),
    (40, 90, 200),
    (235, 120, 40),
    (30, 30, 40),
    (90, 90, 100),
)
PAPER, WALL, PLANNED, DRIVEN, BEAM, BODY, TEXT = COLOURS


@dataclass(slots=True)
class AnimationFrame:
    """Data added by one frame."""

    seconds: float
    """Time since the start of the log (s)."""
    pose: tuple[float, float, float]
    """Pose of base in map (m, rad)."""
    speed: float
    """Speed (m/s)."""
    points: Array
    """Returns of the latest scan in map, or the centres of ``arcs``, shape (n, 2) (m)."""
    path: Array
    """Poses of the current path, shape (n, 3)."""
    arcs: list[Array]
    """Arcs of the latest sonar echoes in map, each of shape (n, 2) (m)."""


@dataclass(slots=True)
class _Gathering:
    """Reads a log in order and keeps one frame per period."""

    period: int
    """Period (ns of log time)."""
    scans: PlacedScans = field(default_factory=PlacedScans)
    scenes: list[AnimationFrame] = field(default_factory=list)
    odometry: Odometry | None = None
    points: Array = field(default_factory=lambda: np.zeros((0, 2)))
    path: Array = field(default_factory=lambda: np.zeros((0, 3)))
    arcs: list[Array] = field(default_factory=list)
    scanned: bool = False
    """Whether the log has scans, which take precedence over echoes."""
    began: int | None = None
    due: int = 0

    def take(self, message: Any, log_time: int) -> None:
        match message:
            case Odometry():
                self.odometry = message
                self.scans.pose(message)
            case Transforms():
                self.scans.transforms(message)
            case DrivePath():
                self.path = message.poses.reshape(-1, 3)
            case LaserScan() if self.odometry is not None:
                self.points, self.scanned = self.scans.place(message)[1], True
            case SonarRanges() if self.odometry is not None:
                self.arcs = self.scans.arcs(message)
                if not self.scanned:
                    self.points = np.array([line[len(line) // 2] for line in self.arcs]).reshape(-1, 2)
        if self.odometry is None:
            return
        if self.began is None:
            self.began = self.due = log_time
        if log_time >= self.due:
            self.due += self.period * (1 + (log_time - self.due) // self.period)
            pose = self.odometry.pose
            seconds = (log_time - self.began) / SECOND
            at = (pose.x, pose.y, pose.yaw)
            speed = self.odometry.twist.vx
            self.scenes.append(AnimationFrame(seconds, at, speed, self.points, self.path, self.arcs))


def animate(
    reader: LogReader, output: Path, *, speed: float, width: int, report: Progress = lambda _: None
) -> dict[str, float]:
    """Write a log as an animated GIF.

    Args:
        reader: reader of the log.
        output: the file.
        speed: ratio of log time to display time.
        width: width (pixels).
        report: called with the bytes read.

    Returns:
        ``frames`` and ``seconds`` of the animation, ``bytes`` of the file.

    Raises:
        InputError: the log has no pose or an invalid robot size, or the animation has too many frames at this speed;
            ``output`` is a log or not a GIF.
        CommandFailedError: the file cannot be written.
    """
    if output.suffix.lower() != ".gif":
        raise InputError(f"{output}: expected a name that ends with .gif")
    spare_log(output)
    frames_per_second = 12.5  # a GIF counts hundredths of a second
    scenes = _scenes(reader, round(speed / frames_per_second * SECOND), report)
    if not scenes:
        raise InputError(f"{reader.path}: contains no poses to draw")
    if len(scenes) > MOST_FRAMES:
        needed = speed * len(scenes) / MOST_FRAMES
        raise InputError(f"{len(scenes)} frames, at most {MOST_FRAMES}: expected --speed {math.ceil(needed)} or more")
    canvas = _AnimationCanvas(scenes, width, recorded_geometry(reader.path, reader.config()))
    rest = 1.5  # display time of the last picture, s
    try:
        with MovingPicture(output, 1 / frames_per_second, rest) as pictures:
            for scene in scenes:
                pictures.add(canvas.frame(scene))
    except OSError as error:
        raise CommandFailedError(f"{output}: {error.strerror or error}") from error
    seconds = (len(scenes) - 1) / frames_per_second + rest
    return {"frames": len(scenes), "seconds": round(seconds, 2), "bytes": output.stat().st_size}


def _scenes(reader: LogReader, period: int, report: Progress) -> list[AnimationFrame]:
    """Return the frames, with poses in map, or in odom if the log has no others."""
    for pose in (POSE.name, ODOMETRY.name):
        gathering = _Gathering(period)
        wanted = {pose, SCAN.name, SONAR.name, PATH.name, TRANSFORMS.name}
        for message in reader:
            report(reader.position)
            if message.topic in wanted:
                try:
                    decoded = message.decode()
                except TruckError:
                    continue
                gathering.take(decoded, message.log_time)
        if gathering.scenes:
            return gathering.scenes
    return []


class _AnimationCanvas:
    """Draws frames; lidar and sonar echoes accumulate.

    Args:
        scenes: all frames, which define the visible area.
        width: width (pixels).
        geometry: geometry of the truck.
    """

    def __init__(self, scenes: list[AnimationFrame], width: int, geometry: Geometry) -> None:
        self._body = np.array([[1, 1], [1, -1], [-1, -1], [-1, 1]]) * (geometry.length / 2, geometry.width / 2)
        poses = np.array([scene.pose[:2] for scene in scenes])
        seen = np.vstack([poses, *(scene.points for scene in scenes)])
        empty_edge = 0.25  # empty margin around the echoes, m
        low = np.minimum(np.quantile(seen, 0.002, axis=0), poses.min(axis=0)) - empty_edge
        high = np.maximum(np.quantile(seen, 0.998, axis=0), poses.max(axis=0)) + empty_edge
        self._low, self._scale = low, width / (high[0] - low[0])
        self._height = max(round((high[1] - low[1]) * self._scale), 16)
        self._ground = Image.new("RGB", (width, self._height), PAPER)
        self._palette = Image.new("P", (1, 1))
        self._palette.putpalette([part for colour in COLOURS for part in colour])
        self._driven: list[tuple[float, float]] = []

    def frame(self, scene: AnimationFrame) -> Image.Image:
        """Return the next frame."""
        ground = ImageDraw.Draw(self._ground)
        for x, y in self._pixels(scene.points):
            ground.point((x, y), WALL)
        self._driven += self._pixels(np.array([scene.pose[:2]]))
        picture = self._ground.copy()
        draw = ImageDraw.Draw(picture)
        for points, colour in ((self._pixels(scene.path[:, :2]), PLANNED), (self._driven, DRIVEN)):
            if len(points) > 1:
                draw.line(points, colour, 2)
        for x, y in self._pixels(scene.points):
            draw.ellipse((x - 1, y - 1, x + 1, y + 1), BEAM)
        for line in scene.arcs:
            draw.line(self._pixels(line), BEAM, 1)
        corners = placed(np.column_stack((self._body, np.zeros(4))), scene.pose)[:, :2]
        draw.polygon(self._pixels(corners), BODY)
        nose = placed(np.array([[self._body[0, 0], 0.0, 0.0]]), scene.pose)[:, :2]
        draw.line(self._pixels(np.vstack((scene.pose[:2], nose))), PAPER, 2)
        draw.text((6, 4), f"{scene.seconds:5.1f} s   {scene.speed:+.2f} m/s", TEXT)
        return picture.quantize(palette=self._palette, dither=Image.Dither.NONE)

    def _pixels(self, points: Array) -> list[tuple[float, float]]:
        """Convert points in map, shape (n, 2) (m), to pixels."""
        scaled = (points - self._low) * self._scale
        return [(x, self._height - y) for x, y in scaled.tolist()]
