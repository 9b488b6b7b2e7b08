"""Configuration of the test stand: cameras, marks on the table, robots."""

from pathlib import Path
from typing import Annotated, ClassVar, Literal

from pydantic import Field

from monstertruck_schemas.base import Schema
from monstertruck_schemas.board import BoardConfig

Metres = Annotated[float, Field(gt=0, le=10)]


class VideoDevice(Schema):
    """A camera of the computer."""

    kind: Literal["v4l2"] = "v4l2"
    device: Path
    """/dev/video0, or better a link by path"""


class FileSource(Schema):
    """Recorded pictures: a film, or a folder of pictures in the order of their names."""

    kind: Literal["file"] = "file"
    path: Path


class RenderedCamera(Schema):
    """A camera under the ceiling of a simulated world, which `simulate` renders."""

    kind: Literal["rendered"] = "rendered"
    port: Path
    """That of `sim.stand.cameras`"""


class StandCamera(Schema):
    """One camera over the table."""

    source: Annotated[VideoDevice | FileSource | RenderedCamera, Field(discriminator="kind")]
    boards: Path
    """Folder with pictures of the board, held anyhow: for the lens"""
    floor: Path
    """Folder with pictures of the table with its marks: for the camera's place"""


class MarkConfig(Schema):
    """A tag that lies on the table for good, measured by ruler from the stand's middle, m."""

    x: float
    y: float


class TaggedRobot(Schema):
    """A robot with a tag on it."""

    tag: Annotated[int, Field(ge=0, le=586)]
    x: float = 0.0
    """Of the tag's middle before the robot's, m"""
    y: float = 0.0
    """And left of it, m"""
    yaw: float = 0.0
    """Of the tag's upper edge's direction against the robot's left, rad"""
    height: Annotated[float, Field(ge=0, le=2)] = 0.08
    """Of the tag over the table, m"""


class OverheadConfig(Schema):
    """The stand."""

    FILE_KEYS: ClassVar[tuple[tuple[str, ...], ...]] = ()

    version: Literal[2]
    cameras: Annotated[dict[Annotated[str, Field(pattern=r"^[a-z][a-z0-9_]{0,31}$")], StandCamera], Field(min_length=1)]
    size: tuple[int, int] = Field((640, 480), strict=False)
    """Width and height of the pictures, pixels"""
    rate: Annotated[float, Field(gt=0, le=120)] = 25.0
    """Pictures a second"""
    board: BoardConfig = BoardConfig()
    marks: dict[int, MarkConfig]
    """Tags on the table by number: five in sight of each camera, or more"""
    mark_size: Metres = 0.08
    """Side of the black square of tags on the table, m"""
    ruler_error: Annotated[float, Field(gt=0, le=0.1)] = 0.0015
    """Standard deviation of a mark's place, m"""
    robots: dict[Annotated[str, Field(pattern=r"^[a-z][a-z0-9_-]{0,31}$")], TaggedRobot]
    calibration: Path = Path("runs/stand/calibration.json")
    """Written by `stand calibrate`"""
