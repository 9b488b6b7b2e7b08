"""Configuration of the camera."""

from typing import Annotated, Literal

from pydantic import Field

from monstertruck_schemas.base import FrameId, Schema
from monstertruck_schemas.body import LensConfig


class WebcamConfig(Schema):
    """A V4L2 camera that sends motion JPEG; sizes and rates are those the camera offers (``probe`` lists them)."""

    kind: Literal["webcam"] = "webcam"
    width: Annotated[int, Field(ge=16, le=4096)] = 640
    """Pixels"""
    height: Annotated[int, Field(ge=16, le=4096)] = 480
    """Pixels"""
    rate: Annotated[float, Field(gt=0, le=120)] = 15.0
    """Pictures a second; the camera takes the nearest it has"""
    watchdog: Annotated[float, Field(gt=0, le=60)] = 2.0
    """Seconds without a whole picture that end the session: a stuck camera reports nothing"""
    buffers: Annotated[int, Field(ge=2, le=32)] = 4
    """Pictures the kernel may keep for us"""
    frame: FrameId = "camera"
    """Frame of the pictures"""
    lens: LensConfig = LensConfig()
    """Lens, for measurements by its pictures"""
