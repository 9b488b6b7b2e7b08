"""Configuration of the test stand: cameras, marks on the table, robots."""

from pathlib import Path
from typing import Annotated, ClassVar, Literal, Self

from pydantic import Field, model_validator

from monstertruck_schemas.base import Name, Schema
from monstertruck_schemas.board import BoardConfig, Colour
from monstertruck_schemas.body import Metres


class VideoDevice(Schema):
    """A camera of the computer."""

    kind: Literal["v4l2"] = "v4l2"
    device: Path
    """Device node: /dev/video0, or preferably a link by path"""


class FileSource(Schema):
    """Recorded images: a film, or a folder of images in the order of their names."""

    kind: Literal["file"] = "file"
    path: Path


class RenderedCamera(Schema):
    """A ceiling camera of a simulated world, rendered by `simulate`."""

    kind: Literal["rendered"] = "rendered"
    port: Path
    """Port of `sim.stand.cameras`"""


class StandCamera(Schema):
    """One camera above the table."""

    source: Annotated[VideoDevice | FileSource | RenderedCamera, Field(discriminator="kind")]
    boards: Path
    """Folder with pictures of the hand-held board, for the lens"""
    floor: Path
    """Folder with pictures of the table and its marks, for the camera's pose"""


class MarkConfig(Schema):
    """A tag fixed on the table, measured with a ruler from the stand's centre (m)."""

    x: float
    y: float


class MarkedRobot(Schema):
    """A robot with a marker."""

    x: float = 0.0
    """Offset of the marker's centre ahead of the robot's centre (m)"""
    y: float = 0.0
    """Offset of the marker's centre to the left of the robot's centre (m)"""
    yaw: float = 0.0
    """Yaw of the marker relative to the robot, left positive (rad)"""
    height: Annotated[float, Field(ge=0, le=2)] = 0.08
    """Height of the marker above the table (m)"""


class TaggedRobot(MarkedRobot):
    """A robot with a tag, whose upper edge points to the front."""

    tag: Annotated[int, Field(ge=0, le=586)]


class BlobRobot(MarkedRobot):
    """A robot with two coloured discs, one ahead of the other."""

    front: Colour
    rear: Colour
    apart: Annotated[float, Field(gt=0.03, le=1)]
    """Distance between the discs' centres (m)"""
    start: Annotated[tuple[float, float] | None, Field(strict=False)] = None
    """Start position (m), for robots that look like others"""

    @model_validator(mode="after")
    def _two_colours(self) -> Self:
        if self.front == self.rear:
            raise ValueError(f"front and rear are both {self.front}: expected two colours, to distinguish the ends")
        return self

    @property
    def colours(self) -> frozenset[Colour]:
        """Colours of both discs."""
        return frozenset((self.front, self.rear))


class OverheadConfig(Schema):
    """Configuration of the stand."""

    FILE_KEYS: ClassVar[tuple[tuple[str, ...], ...]] = ()

    version: Literal[2]
    cameras: Annotated[dict[Annotated[str, Field(pattern=r"^[a-z][a-z0-9_]{0,31}$")], StandCamera], Field(min_length=1)]
    size: tuple[int, int] = Field((640, 480), strict=False)
    """Width and height of the pictures (pixels)"""
    rate: Annotated[float, Field(gt=0, le=120)] = 25.0
    """Picture rate (Hz)"""
    board: BoardConfig = BoardConfig()
    marks: dict[int, MarkConfig]
    """Tags on the table by number; each camera must see at least five"""
    mark_size: Metres = 0.08
    """Side of the black square of tags on the table (m)"""
    ruler_error: Annotated[float, Field(gt=0, le=0.1)] = 0.0015
    """Standard deviation of a mark's measured position (m)"""
    robots: dict[Name, TaggedRobot] = {}
    """Robots with tags"""
    blobs: dict[Name, BlobRobot] = {}
    """Robots with coloured discs"""
    calibration: Path = Path("runs/stand/calibration.json")
    """Calibration file written by `stand calibrate`"""

    @property
    def names(self) -> list[str]:
        """Names of all robots."""
        return [*self.robots, *self.blobs]

    @property
    def colours(self) -> frozenset[Colour]:
        """Colours of all discs."""
        return frozenset(colour for robot in self.blobs.values() for colour in robot.colours)

    @model_validator(mode="after")
    def _distinct(self) -> Self:
        if not self.names:
            raise ValueError("robots and blobs are empty: expected a robot")
        if both := sorted(self.robots.keys() & self.blobs.keys()):
            raise ValueError(f"{', '.join(both)}: expected in robots or in blobs, not in both")
        tags = [robot.tag for robot in self.robots.values()]
        if twice := sorted({tag for tag in tags if tags.count(tag) > 1 or tag in self.marks}):
            raise ValueError(f"tag {twice[0]}: expected on one robot only, and not among the marks")
        for name, robot in self.blobs.items():
            alike = [other for other, its in self.blobs.items() if other != name and its.colours == robot.colours]
            if alike and robot.start is None:
                raise ValueError(f"blobs.{name} has the same colours as {alike[0]}: set `start`, its initial position")
        return self
