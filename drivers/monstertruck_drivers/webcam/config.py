"""Configuration of the camera."""

from typing import Annotated, Literal

from pydantic import Field

from monstertruck_schemas.base import FrameId, Schema
from monstertruck_schemas.body import LensConfig


class WebcamConfig(Schema):
    """A V4L2 camera that sends motion JPEG; the camera must offer the size and rate (``probe`` lists them)."""

    kind: Literal["webcam"] = "webcam"
    width: Annotated[int, Field(ge=16, le=4096)] = 640
    """Width (pixels)"""
    height: Annotated[int, Field(ge=16, le=4096)] = 480
    """Height (pixels)"""
    rate: Annotated[float, Field(gt=0, le=120)] = 15.0
    """Picture rate (Hz); the camera uses the nearest rate it offers"""
    watchdog: Annotated[float, Field(gt=0, le=60)] = 2.0
    """Timeout without a complete picture (s), because a stuck camera reports no error; then the session ends"""
    buffers: Annotated[int, Field(ge=2, le=32)] = 4
    """Number of pictures that the kernel may buffer"""
    frame: FrameId = "camera"
    """Frame of the pictures"""
    lens: LensConfig = LensConfig()
    """Lens, for measurements in its pictures"""
