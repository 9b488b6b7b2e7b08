"""A first-person view as a JPEG: floor, sky and walls whose height follows from their distance."""

import io
import math
from functools import cache
from typing import Final

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from monstertruck_drivers.webcam.source import Mode

FONT_SIZE: Final = 20
WALLS, FLOOR, SKY = 0, 128, 192
"""First palette entries: 128 shades of wall, 64 of floor, 64 of sky."""
HALF_SHADE: Final = 4.0
"""Metres at which a wall is half as bright."""


class Renderer:
    """Pictures of one size; stateless, so that threads may share it.

    Args:
        mode: size in pixels.
        field_of_view: horizontal, rad.
        camera_height: of the camera over the floor, m.
        wall_height: m.
        quality: of the JPEG, 1..95.
    """

    def __init__(
        self,
        mode: Mode,
        *,
        field_of_view: float = math.radians(63.0),
        camera_height: float = 0.25,
        wall_height: float = 0.6,
        quality: int = 75,
    ) -> None:
        self._focal = mode.width / 2 / math.tan(field_of_view / 2)
        across = mode.width / 2 - 0.5 - np.arange(mode.width)
        self.angles: NDArray[np.float64] = np.arctan2(across, self._focal)
        """Direction of every column, rad, left positive; shape (width,)."""
        self._below = (np.arange(mode.height) + 0.5 - mode.height / 2)[:, None]
        self._above_camera, self._camera_height = wall_height - camera_height, camera_height
        depth = np.abs(self._below) / (mode.height / 2) * 63
        self._ground = (np.where(self._below > 0, FLOOR, SKY) + depth).astype(np.uint8)
        self._quality = quality

    def jpeg(self, ranges: NDArray[np.float64], counter: int) -> bytes:
        """Draw one picture.

        Args:
            ranges: (width,) horizontal distance along each of ``angles``, m; inf = nothing.
            counter: drawn into the upper left corner.
        """
        depth = np.maximum(ranges * np.cos(self.angles), 0.05)
        shade = (WALLS + 127 / (1 + depth / HALF_SHADE)).astype(np.uint8)
        is_wall = (self._below > -self._focal * self._above_camera / depth) & (
            self._below < self._focal * self._camera_height / depth
        )
        image = Image.fromarray(np.where(is_wall, shade, self._ground))
        image.putpalette(_palette())
        picture = image.convert("RGB")
        draw = ImageDraw.Draw(picture)
        text = f"{counter:06d}"
        draw.rectangle(draw.textbbox((8, 8), text, font=_font()), fill="black")
        draw.text((8, 8), text, fill="white", font=_font())
        out = io.BytesIO()
        picture.save(out, "JPEG", quality=self._quality)
        return out.getvalue()


@cache
def _palette() -> bytes:
    rows = np.zeros((256, 3))
    ramp = np.linspace(0.0, 1.0, 64)[:, None]
    rows[WALLS:FLOOR] = np.linspace(0.1, 1.0, 128)[:, None] * (225, 215, 200)
    rows[FLOOR:SKY] = (60, 55, 50) + ramp * (60, 55, 45)
    rows[SKY:] = (215, 220, 225) - ramp * (95, 65, 25)
    return rows.astype(np.uint8).tobytes()


@cache
def _font() -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    return ImageFont.load_default(FONT_SIZE)
