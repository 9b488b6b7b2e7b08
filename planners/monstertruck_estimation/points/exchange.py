"""What the reader of pictures is given, and what it answers; light, as the daemon's loop imports it."""

from dataclasses import dataclass, field
from typing import Any, Self

from monstertruck_schemas.board import TagFamily
from monstertruck_schemas.body import LensConfig

Triple = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class ReadTask:
    """A picture to be read."""

    jpeg: bytes
    lens: LensConfig
    size: float
    """Side of tags, m."""
    sizes: dict[int, float] = field(default_factory=dict)
    """Sizes of other tags, by number."""
    reach: float = 2.0
    """m."""
    angle: float = 1.0
    """rad."""
    margin: float = 0.15
    family: TagFamily = "36h11"

    @classmethod
    def of(cls, jpeg: bytes, lens: LensConfig, config: Any) -> Self:
        """By a ``PointsConfig``."""
        return cls(
            jpeg, lens, config.size, dict(config.sizes), config.reach, config.angle, config.margin, config.family
        )


@dataclass(frozen=True, slots=True)
class TagReading:
    """A tag as a picture shows it, in the camera's axes: right, down, ahead."""

    tag: int
    middle: Triple
    """m."""
    normal: Triple
    """Unit vector, out of its front."""
    other_normal: Triple
    """Normal by the second pose that fits the outline."""
    doubt: float
    """How well the second one fits, 0 (not at all) to 1 (as well): the heading means nothing then."""
    pixels: float
    """Mean side of its black square."""
    margin: float
    """Contrast of the worst cell."""
    angle: float
    """Angle from its normal to the camera, rad."""
    picture: bytes = b""
    """Picture of the tag and its surroundings, JPEG."""


@dataclass(frozen=True, slots=True)
class ReadAnswer:
    """What a picture shows."""

    readings: tuple[TagReading, ...] = ()
    unreadable: bool = False
    """The picture is none."""
