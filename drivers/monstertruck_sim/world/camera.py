"""Camera view for the plane engine: walls as columns, tags and people as flat panels, seen through a lens.

Each pixel's ray follows the camera's true lens (Brown's radial distortion) and mount; the ground is level. A panel is
sampled by several rays per pixel, so that a distant tag blurs as on a real sensor.
"""

from collections.abc import Callable, Sequence
from functools import cache, lru_cache
from math import ceil, cos, hypot, sin, tan
from typing import Any, Final, NamedTuple, Protocol

import numpy as np
from numba import njit
from numpy.typing import NDArray

from monstertruck_kinematics.elementary import Array, rotation
from monstertruck_kinematics.se2 import Pose2
from monstertruck_runtime.extras import not_installed
from monstertruck_sim.world.config import CameraConfig, TagConfig
from monstertruck_sim.world.noise import CAMERA, generator
from monstertruck_sim.world.plant import Caster, Plant
from monstertruck_sim.world.scene import Surroundings

Picture = NDArray[np.uint8]
"""Image of shape (height, width, 3): red, green, blue; the top row first."""
Drawing = Callable[[], Picture]
"""Draws a picture; callable in any thread, one call at a time."""

WALLS, FLOOR, SKY = 0, 128, 192
"""First palette entries: 128 shades of wall, 64 of floor, 64 of sky."""
RIM: Final = 1
"""Width of the white paper around a tag's black square, in cells; the square has eight."""
CELLS: Final = 8
PAPER_CELLS: Final = CELLS + 2 * RIM
PAPER, INK = 235, 20
_GRAIN: Final = 64
"""Maximum shift of the sensor's grain from picture to picture (pixels)."""


class CameraPlace(NamedTuple):
    """Camera pose at one time."""

    centre: Array
    """Position of the lens in the map, (3,) (m)."""
    axes: Array
    """Rows: right, down and optical axis of the camera in the map, (3, 3)."""


class FlatPanel(NamedTuple):
    """Flat image in the world, visible only from the front."""

    texture: NDArray[np.uint8]
    """(rows, columns, 3)."""
    opaque: NDArray[np.bool_]
    """(rows, columns)."""
    corner: Array
    """Upper left corner, (3,) (m)."""
    right: Array
    """Upper edge, (3,) (m)."""
    down: Array
    """Left edge, (3,) (m)."""
    smooth: bool = False
    """Whether to interpolate between its pixels (OpenCV), with two samples per image pixel each way: exact edges."""


class Holder(Protocol):
    """A person who holds a board in front of a camera."""

    def panel_at(self, time_ns: int, place: CameraPlace, /) -> FlatPanel:
        """Return the board at a time, in front of a camera at ``place``."""


def mounted(pose: Pose2, config: CameraConfig, attitude: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> CameraPlace:
    """Return the camera place of a robot at ``pose``.

    Args:
        pose: pose of the robot's geometric centre.
        config: camera mount.
        attitude: pitch (rad), roll (rad) and height (m) of the body.
    """
    body = rotation(pose[2], *attitude[:2])
    centre = np.array((pose[0], pose[1], attitude[2])) + body @ np.array((config.x, config.y, config.height))
    forward, left, up = (body @ rotation(config.yaw, config.pitch, config.roll)).T
    return CameraPlace(centre, np.stack((-left, -up, forward)))


class SimulatedView:
    """``ViewSource`` for a camera that is fixed to the robot.

    Args:
        plant: carrier of the camera.
        cast: ranges to walls, obstacles, people and robots.
        config: lens, mount and noise.
        tags: tags on the walls.
        crowd: people in the world.
        holder: person who holds a board in front of the camera.
        wall_height: height of the walls (m).
        seed: noise seed; None for no noise.

    Raises:
        NotInstalledError: tags need the extra ``vision``.
    """

    def __init__(
        self,
        plant: Plant,
        cast: Caster,
        config: CameraConfig,
        *,
        tags: Sequence[TagConfig] = (),
        crowd: Surroundings | None = None,
        holder: Holder | None = None,
        wall_height: float = 0.6,
        seed: int | None = None,
    ) -> None:
        self.plant, self._cast, self.config, self.crowd, self._seed = plant, cast, config, crowd, seed
        self._holder = holder
        self._wall_height = wall_height
        self._painters: dict[tuple[int, int], Painter] = {}
        self._panels = [tag_panel(tag) for tag in tags]

    def ranges(self, time_ns: int, angles: Array) -> Array:
        """Return the distances (m) at ``time_ns`` along ``angles`` from the truck's axis, (n,); inf without a hit."""
        self.plant.advance(time_ns)
        x, y, yaw = self.plant.poses(np.array([time_ns]))[:3, 0]
        c, s = cos(yaw), sin(yaw)
        ahead, aside = self.config.x, self.config.y
        count = len(angles)
        xs, ys = np.full(count, x + ahead * c - aside * s), np.full(count, y + ahead * s + aside * c)
        return self._cast(xs, ys, yaw + angles, self.config.reach)

    def exposure(self, time_ns: int, size: tuple[int, int]) -> Drawing:
        """Read the world's state now, and draw the image when the result is called."""
        painter = self._painter(size)
        ranges = self.ranges(time_ns, painter.azimuths)
        place = self._place(time_ns)
        panels = self._in_view(place)
        if self.crowd is not None:
            panels += [person_panel(*person, place) for person in self.crowd.people_at(time_ns)]
        if (board := self.board_at(time_ns)) is not None:
            panels.append(board)
        sensor = self.sensor(time_ns)
        return lambda: sensor(painter.picture(ranges, panels, place))

    def board_at(self, time_ns: int) -> FlatPanel | None:
        """Return the board that a person holds in front of the camera, or None."""
        return None if self._holder is None else self._holder.panel_at(time_ns, self._place(time_ns))

    def _place(self, time_ns: int) -> CameraPlace:
        x, y, yaw = self.plant.poses(np.array([time_ns]))[:3, 0].tolist()
        return mounted((x, y, yaw), self.config)

    def _painter(self, size: tuple[int, int]) -> "Painter":
        if size not in self._painters:
            self._painters[size] = Painter(self.config, size, self._wall_height)
        return self._painters[size]

    def sensor(self, time_ns: int) -> Callable[[Picture], Picture]:
        """Return a function that applies the effects of light, lens and sensor at one time to a drawn image."""
        config, seed = self.config, self._seed
        if seed is None or not config.noise:
            return lambda picture: lit(picture, config)
        row, column = generator(seed, CAMERA, self.plant.slot(time_ns, 1_000_000)).integers(0, _GRAIN, 2).tolist()
        return lambda picture: _grainy(lit(picture, config), seed, config.noise, row, column)

    def _in_view(self, place: CameraPlace) -> list[FlatPanel]:
        """Return the panels in view that face the camera, farthest first."""
        found = []
        for panel in self._panels:
            away = panel.corner + (panel.right + panel.down) / 2 - place.centre
            front = np.cross(panel.down, panel.right)
            # 12.0: maximum distance of drawn panels, m: there a tag of 10 cm has 4 pixels
            if away @ place.axes[2] > 0.05 and away @ front < 0 and (far := float(np.linalg.norm(away))) < 12.0:
                found.append((far, panel))
        return [panel for _, panel in sorted(found, key=lambda row: -row[0])]


class Painter:
    """Draws images of one size; stateless, so that threads may share it.

    Args:
        config: lens and mount.
        size: width and height (pixels).
        wall_height: height of the walls (m).
    """

    def __init__(self, config: CameraConfig, size: tuple[int, int], wall_height: float) -> None:
        width, height = size
        self._config, self._size = config, size
        self._focal = width / 2 / tan(config.field_of_view / 2)
        self._above, self._below = wall_height - config.height, config.height
        bent = bool(config.k1 or config.k2 or config.pitch or config.roll)
        if bent:
            x, y = np.meshgrid(np.arange(width) - (width - 1) / 2, np.arange(height) - (height - 1) / 2)
            right, down = self._straight(x / self._focal, y / self._focal)
            turned = rotation(0.0, config.pitch, config.roll)
            forward, left, up = np.einsum("ij,jhw->ihw", turned, np.stack((np.ones_like(right), -right, -down)))
            level = np.hypot(forward, left)
            angles = np.arctan2(left, forward)
            edge = float(np.abs(angles).max())
            count = ceil(width * edge / (config.field_of_view / 2))
            fan = np.linspace(edge, -edge, count)
            column = np.clip(np.rint((edge - angles) / (2 * edge) * (count - 1)), 0, count - 1)
            slope = (-up / level).astype(np.float32)
            self._along = np.ones(count, np.float32)
        else:
            fan = np.arctan2((width - 1) / 2 - np.arange(width), self._focal)
            column = np.arange(width)
            slope = ((np.arange(height) - (height - 1) / 2) / self._focal).astype(np.float32)[:, None]
            self._along = np.cos(fan).astype(np.float32)
        self._fan = fan
        self.azimuths: Array = fan + config.yaw
        """Directions of the required ranges from the robot's axis, decreasing (rad)."""
        depth = np.minimum(np.abs(slope) * self._focal / (height / 2), 1.0) * 63
        ground = (np.where(slope > 0, FLOOR, SKY) + depth).astype(np.uint8)
        self._column, self._slope, self._ground = (
            np.array(np.broadcast_to(part, (height, width)), order="C")
            for part in (column.astype(np.int32), slope, ground)
        )
        """Per pixel: index of its azimuth in the fan, slope, and shade where no wall is."""

    def picture(self, ranges: Array, panels: Sequence[FlatPanel], place: CameraPlace) -> Picture:
        """Draw an image.

        Args:
            ranges: horizontal distance along each of ``azimuths``, (n,) (m); inf without a hit.
            panels: panels in drawing order, the last one on top.
            place: camera place.
        """
        depth = np.maximum(ranges * self._along, 0.05).astype(np.float32)
        shade = (WALLS + 127 / (1 + depth / 4.0)).astype(np.uint8)  # distance of half brightness, m
        edges = -self._above / depth, self._below / depth
        picture: Picture = _painted(self._slope, self._column, *edges, shade, self._ground, _palette())
        for panel in panels:
            self.draw(picture, panel, place, ranges)
        return picture

    def draw(self, picture: Picture, panel: FlatPanel, place: CameraPlace, ranges: Array) -> None:
        """Draw a panel over a picture; see ``picture`` for the arguments."""
        corners = panel.corner + np.array((panel.right * 0, panel.right, panel.right + panel.down, panel.down))
        seen = (corners - place.centre) @ place.axes.T
        if (seen[:, 2] < 0.05).any():
            return
        width, height = self._size
        flat, edge = seen[:, :2] / seen[:, 2:], 1.3 * width / 2 / self._focal
        at = self._bent(*np.clip(flat, -edge, edge).T) * self._focal + np.array(((width - 1) / 2, (height - 1) / 2))
        at = np.where(np.abs(flat) > edge, np.sign(flat) * 2 * width, at)  # the lens's terms are invalid far outside
        (x0, y0), (x1, y1) = np.floor(at.min(axis=0)).astype(int) - 1, np.ceil(at.max(axis=0)).astype(int) + 2
        x0, y0, x1, y1 = max(int(x0), 0), max(int(y0), 0), min(int(x1), width), min(int(y1), height)
        if x0 >= x1 or y0 >= y1:
            return
        # 4: maximum rays per pixel, along and across 80_000: maximum rays per panel; a panel that fills the image has
        # fewer rays per pixel
        finer = max(1 + panel.smooth, min(4, int((80_000 / ((x1 - x0) * (y1 - y0))) ** 0.5)))
        part = (np.arange(finer) + 0.5) / finer - 0.5
        us = (np.arange(x0, x1)[:, None] + part).ravel() - (width - 1) / 2
        vs = (np.arange(y0, y1)[:, None] + part).ravel() - (height - 1) / 2
        right, down = self._straight(*np.meshgrid(us / self._focal, vs / self._focal))
        rays = np.stack((right, down, np.ones_like(right)), axis=-1) @ place.axes
        normal = np.cross(panel.right, panel.down)
        with np.errstate(divide="ignore", invalid="ignore"):
            way = (normal @ (panel.corner - place.centre)) / (rays @ normal)
            points = way[..., None] * rays
            on = points + (place.centre - panel.corner)
            rows, columns = panel.opaque.shape
            across = on @ panel.right / (panel.right @ panel.right) * columns
            along = on @ panel.down / (panel.down @ panel.down) * rows
            u, v = np.floor(across), np.floor(along)
            inside = (u >= 0) & (u < columns) & (v >= 0) & (v < rows) & (way > 0)
        u, v = np.where(inside, u, 0).astype(np.intp), np.where(inside, v, 0).astype(np.intp)
        inside &= panel.opaque[v, u] & self._unhidden(points, place, ranges)
        shape = (y1 - y0, finer, x1 - x0, finer)
        share = inside.reshape(shape).mean(axis=(1, 3))[..., None]
        shades = _between(panel.texture, across, along) if panel.smooth else panel.texture[v, u]
        colours = np.where(inside[..., None], shades, 0).reshape(*shape, 3).mean(axis=(1, 3))
        window = picture[y0:y1, x0:x1]
        window[:] = np.rint(colours + (1 - share) * window).astype(np.uint8)

    def _unhidden(self, points: Array, place: CameraPlace, ranges: Array) -> NDArray[np.bool_]:
        """Return which points (relative to the camera, in map axes) are not hidden by a wall."""
        axis = place.axes[2]
        ahead = np.arctan2(axis[1], axis[0])
        azimuths = np.angle(np.exp(1j * (np.arctan2(points[..., 1], points[..., 0]) - ahead)))
        fan = self._fan
        at = np.clip(np.searchsorted(-fan, -azimuths), 0, len(fan) - 1)
        # 0.08: maximum depth of a panel behind a wall that carries it, m; it is drawn in front of the wall
        found: NDArray[np.bool_] = np.hypot(points[..., 0], points[..., 1]) < ranges[at] + 0.08
        return found

    def straight_pixels(self) -> tuple[float, Array]:
        """Return the scale of an undistorted image that covers the view, and every pixel's position in it, (h, w, 2).

        The undistorted image has the same number of pixels.
        """
        width, height = self._size
        x, y = np.meshgrid(np.arange(width) - (width - 1) / 2, np.arange(height) - (height - 1) / 2)
        right, down = self._straight(x / self._focal, y / self._focal)
        right, down = right * self._focal, down * self._focal
        wider = max(1.0, 2 * float(np.abs(right).max()) / (width - 1), 2 * float(np.abs(down).max()) / (height - 1))
        return wider, np.stack((right / wider + (width - 1) / 2, down / wider + (height - 1) / 2), axis=-1)

    def _bent(self, right: Array, down: Array) -> Array:
        """Return the image points for directions, in focal lengths, (n, 2)."""
        square = right**2 + down**2
        factor = 1 + self._config.k1 * square + self._config.k2 * square**2
        return np.stack((right * factor, down * factor), axis=-1)

    def _straight(self, right: Array, down: Array) -> tuple[Array, Array]:
        """Return the directions for image points, in focal lengths: the inverse of ``_bent``."""
        if not (self._config.k1 or self._config.k2):
            return right, down
        x, y = right, down
        for _ in range(6):  # iterations that undo the lens's distortion
            square = x**2 + y**2
            factor = 1 + self._config.k1 * square + self._config.k2 * square**2
            x, y = right / factor, down / factor
        return x, y


def compile_kernels() -> None:
    """Compile the drawing functions unless already compiled; blocks the process for about a second."""
    config = CameraConfig()
    picture = Painter(config, (2, 2), 0.6).picture(np.ones(2), (), mounted((0.0, 0.0, 0.0), config))
    _grainy(picture, 0, 1.0, 0, 0)


# Panels


def _between(texture: NDArray[np.uint8], across: Array, along: Array) -> NDArray[np.uint8]:
    """Sample a texture by bilinear interpolation at pixel positions, where integers are pixel corners."""
    cv2 = opencv("sim.world.board")
    at = (np.nan_to_num(places - 0.5, posinf=-1.0, neginf=-1.0).astype(np.float32) for places in (across, along))
    return np.asarray(cv2.remap(texture, *at, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE), dtype=np.uint8)


def opencv(key: str) -> Any:
    """Import OpenCV, which drawing the configuration's ``key`` requires.

    Raises:
        NotInstalledError: the extra ``vision`` is not installed.
    """
    try:
        import cv2  # noqa: PLC0415  # the library of an extra
    except ModuleNotFoundError as error:
        raise not_installed(f"{key}: opencv", "vision") from error
    return cv2


@cache
def tag_pattern(tag: int) -> NDArray[np.uint8]:
    """Return a 36h11 tag with its white border, one pixel per cell, (10, 10).

    Raises:
        NotInstalledError: the extra ``vision`` is not installed.
    """
    cv2 = opencv("sim.world.tags")
    family = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    inner = cv2.aruco.generateImageMarker(family, tag, CELLS)
    return np.pad(np.where(np.asarray(inner) > 127, PAPER, INK).astype(np.uint8), RIM, constant_values=PAPER)


def tag_panel(tag: TagConfig) -> FlatPanel:
    """Return the panel of a tag: upright and facing ``yaw``, or lying flat with its upper edge towards ``yaw``."""
    pattern = tag_pattern(tag.tag)
    side = tag.size * len(pattern) / CELLS
    right, up = tag_axes(tag.yaw, lies=tag.lies)
    right, down = right * side, -up * side
    corner = np.array((tag.x, tag.y, tag.z)) - (right + down) / 2
    return FlatPanel(np.repeat(pattern[..., None], 3, axis=2), np.ones(pattern.shape, np.bool_), corner, right, down)


def tag_axes(yaw: float, *, lies: bool) -> tuple[Array, Array]:
    """Return the unit vectors of a tag's upper edge, from left to right, and of its upward direction."""
    c, s = cos(yaw), sin(yaw)
    if lies:
        return np.array((s, -c, 0.0)), np.array((c, s, 0.0))
    return np.array((-s, c, 0.0)), np.array((0.0, 0.0, 1.0))


def person_panel(x: float, y: float, radius: float, place: CameraPlace) -> FlatPanel:
    """Return the panel of a person, facing the camera."""
    texture, opaque = _person()
    toward = place.centre[:2] - (x, y)
    toward = toward / max(hypot(*toward), 1e-6)
    right = np.array((-toward[1], toward[0], 0.0)) * 2 * radius
    down = np.array((0.0, 0.0, -1.7))  # height of a person, m
    nearest = np.array((*((x, y) + toward * radius), 0.0))
    return FlatPanel(texture, opaque, nearest - right / 2 - down, right, down)


@cache
def _person() -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
    """Return a person's texture and outline, at 2 cm per pixel for a radius of 0.2 m."""
    rows, columns = np.mgrid[0:85, 0:20]
    head = ((rows - 7) / 7.5) ** 2 + ((columns - 9.5) / 5.5) ** 2 < 1
    trunk = (rows >= 15) & (rows < 46) & (np.abs(columns - 9.5) < 9.6 - np.maximum(0, 18 - rows))
    legs = (rows >= 46) & (np.abs(columns - 9.5) < 7.6) & (np.abs(columns - 9.5) > 0.6)
    texture = np.zeros((85, 20, 3), np.uint8)
    texture[head], texture[trunk], texture[legs] = (205, 160, 130), (150, 60, 50), (50, 60, 90)
    return texture, head | trunk | legs


@cache
def _palette() -> NDArray[np.uint8]:
    """Return the palette, (256, 3)."""
    rows = np.zeros((256, 3))
    ramp = np.linspace(0.0, 1.0, 64)[:, None]
    rows[WALLS:FLOOR] = np.linspace(0.1, 1.0, 128)[:, None] * (225, 215, 200)
    rows[FLOOR:SKY] = (60, 55, 50) + ramp * (60, 55, 45)
    rows[SKY:] = (215, 220, 225) - ramp * (95, 65, 25)
    return rows.astype(np.uint8)


def lit(picture: Picture, config: CameraConfig) -> Picture:
    """Return a picture with the configured brightness and blur.

    Raises:
        NotInstalledError: the extra ``vision``, needed for ``blur``, is not installed.
    """
    if config.brightness != 1.0 or config.gradient:
        gain = config.brightness * (1.0 + config.gradient * np.linspace(1.0, -1.0, picture.shape[1], dtype=np.float32))
        picture = np.minimum(picture * gain[:, None], 255.0).astype(np.uint8)
    if config.blur:
        cv2 = opencv("sim.world.camera.blur")
        picture = np.asarray(cv2.GaussianBlur(picture, (0, 0), config.blur), dtype=np.uint8)
    return picture


def _grainy(picture: Picture, seed: int, noise: float, row: int, column: int) -> Picture:
    noisy: Picture = _added(picture, _grain(seed, noise, *picture.shape[:2]), row, column)
    return noisy


@njit(cache=True)
def _added(picture: Picture, grain: NDArray[np.int16], row: int, column: int) -> Picture:
    """Add the grain tile that begins at (row, column), identical in all colours."""
    height, width, colours = picture.shape
    noisy = np.empty_like(picture)
    for i in range(height):
        for j in range(width):
            more = grain[row + i, column + j]
            for k in range(colours):
                noisy[i, j, k] = min(max(picture[i, j, k] + more, 0), 255)
    return noisy


@njit(cache=True)
def _painted(
    slope: NDArray[np.float32],
    column: NDArray[np.int32],
    upper: NDArray[np.float32],
    lower: NDArray[np.float32],
    shade: NDArray[np.uint8],
    ground: NDArray[np.uint8],
    palette: NDArray[np.uint8],
) -> Picture:
    """Return the colours of pixels (height, width): wall between the fan column's slopes, otherwise ground."""
    height, width = slope.shape
    picture = np.empty((height, width, 3), np.uint8)
    for i in range(height):
        for j in range(width):
            at = column[i, j]
            colour = palette[shade[at] if upper[at] < slope[i, j] < lower[at] else ground[i, j]]
            for k in range(3):
                picture[i, j, k] = colour[k]
    return picture


@lru_cache(maxsize=4)
def _grain(seed: int, noise: float, height: int, width: int) -> NDArray[np.int16]:
    drawn = generator(seed, CAMERA).standard_normal((height + _GRAIN, width + _GRAIN))
    return np.rint(noise * drawn).astype(np.int16)
