"""Settings for a camera that sends motion JPEG over a link."""

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from monstertruck_schemas.base import FrameId, Schema
from monstertruck_schemas.body import LensConfig


class MjpegConfig(Schema):
    """Motion JPEG from a program's output, from a TCP port or from an HTTP server."""

    kind: Literal["mjpeg"] = "mjpeg"
    http: Annotated[str, Field(pattern=r"^/[!-~]*$")] | None = None
    """Path on the HTTP server at the port, such as /stream: multipart or single pictures; null: the port sends
    pictures without HTTP"""
    poll: Annotated[float, Field(gt=0, le=30)] | None = None
    """Polling rate if ``http`` returns a single picture (Hz); null: it streams"""
    width: Annotated[int, Field(ge=16, le=4096)] = 640
    """Configured width of the camera (pixels); other sizes are reported"""
    height: Annotated[int, Field(ge=16, le=4096)] = 480
    """Configured height of the camera (pixels)"""
    rate: Annotated[float, Field(gt=0, le=120)] = 15.0
    """Configured rate of the camera (pictures/s)"""
    delay: Annotated[float, Field(ge=0, le=1)] = 0.0
    """Time from exposure to arrival (s): the images contain no time stamps"""
    most: Annotated[int, Field(ge=10_000, le=10_000_000)] = 2_000_000
    """Maximum length of a picture (bytes)"""
    watchdog: Annotated[float, Field(gt=0, le=60)] = 5.0
    """Timeout without a complete picture (s), including the start of the camera by a program; then the session ends"""
    frame: FrameId = "camera"
    """Frame of the pictures"""
    lens: LensConfig = LensConfig()
    """Lens, for measurements in its pictures"""

    @model_validator(mode="after")
    def _polls_by_http(self) -> Self:
        if self.poll is not None and self.http is None:
            raise ValueError("poll: only an HTTP server is polled; set http to the path of its image")
        return self

    @property
    def buffers(self) -> int:
        """Number of latest pictures that are kept."""
        return 1
