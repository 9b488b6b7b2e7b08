"""Pictures of a simulated stand: level tags on a table, and a board held anyhow, through lenses with distortion.

Every pixel is a bundle of 2 x 2 rays, which stands for its area; then blur, light and noise.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np

from monstertruck_estimation.vision.tags import Picture, dictionary, drawn
from monstertruck_kinematics.elementary import Array
from monstertruck_schemas.board import BoardConfig
from monstertruckd.tools.stand.camera import PlacedCamera

FINER: Final = 2
"""Rays of a pixel, along and across."""
TEXTURE: Final = 240
"""Pixels of a tag's black square."""
RIM: Final = 0.2
"""White rim of a tag, in its sizes."""
FLOOR: Final = 140.0
"""Grey of the table."""


@dataclass(frozen=True)
class Placard:
    """A flat picture somewhere."""

    texture: Picture
    """Grey, or blue, green and red"""
    origin: Array
    """(3,): of its upper left corner, m."""
    right: Array
    """(3,): along its upper edge, as long as it, m."""
    down: Array
    """(3,): along its left edge."""


@dataclass(frozen=True)
class PictureQuality:
    """What spoils a picture."""

    blur: float = 0.7
    """Standard deviation, pixels"""
    noise: float = 3.0
    """Standard deviation, of 255"""
    light: float = 1.0
    """Share"""


def level_tag(tag: int, size: float, x: float, y: float, yaw: float, height: float) -> Placard:
    """A tag with its white rim, its upper edge towards ``yaw``."""
    ahead = np.array((np.cos(yaw), np.sin(yaw), 0.0))
    right = np.array((ahead[1], -ahead[0], 0.0))
    side = size * (1 + 2 * RIM)
    origin = np.array((x, y, height)) + (ahead - right) * side / 2
    rim = round(TEXTURE * RIM)
    texture = cv2.copyMakeBorder(drawn(tag, TEXTURE), rim, rim, rim, rim, cv2.BORDER_CONSTANT, value=255)
    return Placard(np.asarray(texture, dtype=np.uint8), origin, right * side, -ahead * side)


PLATE: Final = (0.2, 0.12)
"""Length and width of a plate with discs, m."""
DISC: Final = 0.04
"""m across."""
PAINTS: Final = {
    "red": (40, 40, 200),
    "yellow": (30, 200, 220),
    "green": (60, 170, 50),
    "blue": (200, 90, 30),
    "magenta": (170, 40, 190),
}
"""Blue, green and red."""


def disc_plate(
    front: str, rear: str, x: float, y: float, yaw: float, *, apart: float = 0.1, height: float = 0.08
) -> Placard:
    """A dark plate with two coloured discs, its front towards ``yaw``."""
    scale = 1000
    texture = np.full((round(PLATE[0] * scale), round(PLATE[1] * scale), 3), 45, np.uint8)
    for paint, ahead in ((front, 0.5), (rear, -0.5)):
        middle = round(PLATE[1] * scale / 2), round((PLATE[0] / 2 - ahead * apart) * scale)
        cv2.circle(texture, middle, round(DISC * scale / 2), PAINTS[paint], -1)
    forward = np.array((np.cos(yaw), np.sin(yaw), 0.0))
    right = np.array((forward[1], -forward[0], 0.0))
    origin = np.array((x, y, height)) + (forward * PLATE[0] - right * PLATE[1]) / 2
    return Placard(texture, origin, right * PLATE[1], -forward * PLATE[0])


def board_in_view(board: BoardConfig, camera: PlacedCamera, rng: np.random.Generator) -> Placard:
    """The board, held somewhere in a camera's view, tilted by up to 40 degrees."""
    printed = cv2.aruco.CharucoBoard((board.columns, board.rows), board.square, board.marker, dictionary())
    pixels = 40
    texture = np.asarray(printed.generateImage((board.columns * pixels, board.rows * pixels), marginSize=0))
    away = camera.centre[2] * rng.uniform(0.3, 0.5)
    width, height = camera.lens.size
    pixel = np.array([(width * rng.uniform(0.3, 0.7), height * rng.uniform(0.3, 0.7))])
    ray = np.append(camera.lens.directions(pixel)[0], 1.0) * away
    turned, _ = cv2.Rodrigues(np.array((*rng.uniform(-0.5, 0.5, 2), rng.uniform(-np.pi, np.pi))))
    right, down = turned[:, 0] * board.columns * board.square, turned[:, 1] * board.rows * board.square
    axes, centre = camera.axes, camera.centre
    return Placard(texture, axes.T @ (ray - right / 2 - down / 2) + centre, axes.T @ right, axes.T @ down)


class StandRenderer:
    """Pictures of one camera.

    Args:
        camera: true one.
        look: blur, noise, light.
        seed: of the noise.
    """

    def __init__(self, camera: PlacedCamera, look: PictureQuality, seed: int) -> None:
        self._camera = camera
        self._look = look
        self._rng = np.random.default_rng(seed)
        width, height = camera.lens.size
        at = (np.arange(width * FINER) + 0.5) / FINER - 0.5, (np.arange(height * FINER) + 0.5) / FINER - 0.5
        x, y = np.meshgrid(*at)
        flat = camera.lens.directions(np.column_stack((x.ravel(), y.ravel())))
        rays = np.column_stack((flat, np.ones(len(flat)))) @ camera.axes
        self._rays = rays.reshape(height * FINER, width * FINER, 3).astype(np.float32)
        self._floor = self._table()

    def picture(self, placards: Sequence[Placard], look: PictureQuality | None = None) -> Picture:
        """With what is given, the last one on top; in colour where something is coloured."""
        colour = any(placard.texture.ndim == 3 for placard in placards)
        image = np.repeat(self._floor[..., None], 3, axis=2) if colour else self._floor.copy()
        for placard in placards:
            self._draw(image, placard)
        return self._spoiled(image, look or self._look)

    def _draw(self, image: Array, placard: Placard) -> None:
        corners = placard.origin + np.array(
            ((0.0, 0.0, 0.0), placard.right, placard.right + placard.down, placard.down)
        )
        camera = self._camera
        if ((corners - camera.centre) @ camera.axes[2] < 0.05).any():
            return
        shown = (camera.project(corners) + 0.5) * FINER
        low, high = np.floor(shown.min(axis=0)).astype(int) - 8, np.ceil(shown.max(axis=0)).astype(int) + 8
        x0, y0 = max(low[0], 0), max(low[1], 0)
        x1, y1 = min(high[0], image.shape[1]), min(high[1], image.shape[0])
        if x0 >= x1 or y0 >= y1:
            return
        rays = self._rays[y0:y1, x0:x1].astype(np.float64)
        normal = np.cross(placard.right, placard.down)
        way = float(normal @ (placard.origin - camera.centre)) / (rays @ normal)
        points = way[..., None] * rays + (camera.centre - placard.origin)
        rows, columns = placard.texture.shape[:2]
        u = (points @ placard.right) / float(placard.right @ placard.right) * columns - 0.5
        v = (points @ placard.down) / float(placard.down @ placard.down) * rows - 0.5
        inside = (u > -0.5) & (u < columns - 0.5) & (v > -0.5) & (v < rows - 0.5) & (way > 0)
        sampled = cv2.remap(
            placard.texture,
            u.astype(np.float32),
            v.astype(np.float32),
            cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_REPLICATE,
        )
        part = image[y0:y1, x0:x1]
        part[inside] = sampled[inside] if sampled.ndim == part.ndim else sampled[inside][:, None]

    def _table(self) -> Array:
        """The empty table: grey, with the grain of wood."""
        rays = self._rays
        way = -self._camera.centre[2] / rays[..., 2]
        x, y = (self._camera.centre[i] + way * rays[..., i] for i in (0, 1))
        grain = 6 * np.sin(40 * x + 3 * np.sin(3 * y)) + 4 * np.sin(23 * y + 5 * np.sin(2 * x))
        return np.asarray(FLOOR + grain, dtype=np.float32)

    def _spoiled(self, image: Array, look: PictureQuality) -> Picture:
        small = cv2.resize(image, self._camera.lens.size, interpolation=cv2.INTER_AREA)
        if look.blur > 0:
            small = cv2.GaussianBlur(small, (0, 0), look.blur)
        noise = self._rng.standard_normal(small.shape, dtype=np.float32) * look.noise
        return np.asarray(np.clip(look.light * np.asarray(small) + noise, 0, 255), dtype=np.uint8)
