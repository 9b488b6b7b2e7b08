"""Worker that accumulates scans and draws paths over them: ``monstertruckd.recorder.picture_worker:MapRenderer``.

A step's inputs are a dict:

- ``scans``: list of (pose, points): sensor pose (x, y, yaw) in the map frame (m, rad); points shape (n, 2) in the
  sensor's frame (m);
- ``render``: absent, or what to draw: ``title``, ``subtitle`` and ``paths``, a list of dicts with ``name``, ``poses``
  (shape (n, 2) or (n, 3), map frame) and ``style``, a key of ``STYLES``;
- ``file``: path of the picture, which is written atomically.

Its outputs are a dict: ``scans``, the number of scans added since the start, and for a picture ``png`` (or ``error``,
why it could not be saved).
"""

import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, ImageChops, ImageDraw, ImageFont

from monstertruck_kinematics.elementary import Array
from monstertruckd.recorder.occupancy import Area, OccupancyRaster

Point = tuple[float, float]


@dataclass(frozen=True, slots=True)
class Style:
    """Drawing style of a path; widths in final pixels."""

    color: str
    width: float
    dash: float | None = None


STYLES: Mapping[str, Style] = {
    "planned": Style("#1f6fd1", 2.5, dash=9),
    "driven": Style("#e0482f", 3.0),
    "true": Style("#14935a", 2.0, dash=4),
}

_UNKNOWN, _FREE, _WALL = (np.array(rgb, dtype=np.float64) for rgb in ((216, 221, 227), (250, 251, 252), (34, 43, 54)))
_INK, _FAINT, _RULE, _PAPER = "#222b36", "#6b7785", "#c3cad3", "#ffffff"
_OVERSAMPLING = 2
_MARGIN, _HEAD, _FOOT = 28, 84, 64


class MapRenderer:
    """The worker; see the module docstring."""

    def __init__(self) -> None:
        self._raster = OccupancyRaster()
        self._scans = 0

    def step(self, inputs: Mapping[str, Any]) -> dict[str, Any]:
        """Add scans, then draw if requested."""
        for pose, points in inputs.get("scans", ()):
            x, y, yaw = pose
            cos, sin = np.cos(yaw), np.sin(yaw)
            turned = np.asarray(points, dtype=np.float64) @ np.array([[cos, sin], [-sin, cos]])
            origin = np.array([x, y], dtype=np.float64)
            self._raster.add(origin, origin + turned)
            self._scans += 1
        outputs: dict[str, Any] = {"scans": self._scans}
        if (request := inputs.get("render")) is not None:
            outputs["png"] = render(self._raster, **request)
            if (file := inputs.get("file")) is not None:
                try:
                    _save(Path(file), outputs["png"])
                except OSError as error:
                    outputs["error"] = str(error)
        return outputs


def _save(file: Path, data: bytes) -> None:
    file.parent.mkdir(parents=True, exist_ok=True)
    scratch = file.with_name(file.name + ".new")
    scratch.write_bytes(data)
    scratch.replace(file)


def render(
    raster: OccupancyRaster, *, title: str, subtitle: str = "", paths: Sequence[Mapping[str, Any]] = ()
) -> bytes:
    """Draw ``paths`` over ``raster`` with title, legend and scale bar; return a PNG.

    Raises:
        KeyError: a path has an unknown style.
    """
    drawn = [(path["name"], STYLES[path["style"]], np.asarray(path["poses"], dtype=np.float64)) for path in paths]
    frame = _Frame.around(_shown(raster, [poses for _, _, poses in drawn if len(poses)]))
    sheet = Image.new("RGB", frame.sheet_size, _PAPER)
    background = _background(raster, frame)
    _rule(background, frame)
    sheet.paste(background, frame.to_sheet(0, 0))
    pen = ImageDraw.Draw(sheet)
    for _, style, poses in drawn:
        _line(pen, [frame.pixel(*pose[:2]) for pose in poses], style)
    for _, style, poses in drawn:
        if len(poses):
            _ends(pen, frame, poses, style)
    left, top = frame.to_sheet(0, 0)
    right, bottom = frame.to_sheet(*frame.map_size)
    scale = _OVERSAMPLING
    pen.rectangle((left, top, right, bottom), outline=_FAINT, width=scale)
    pen.text((left, 14 * scale), title, fill=_INK, font=_font(26))
    pen.text((left, 50 * scale), subtitle, fill=_FAINT, font=_font(16))
    _scale_bar(pen, frame, sheet.width - left, bottom)
    _legend(pen, left, bottom, [(name, style) for name, style, _ in drawn])
    data = io.BytesIO()
    sheet.reduce(scale).save(data, "PNG")
    return data.getvalue()


@dataclass(frozen=True, slots=True)
class _Frame:
    """Transform from metres to pixels of the oversampled sheet."""

    area: Area
    scale: float
    """Pixels per metre."""

    @classmethod
    def around(cls, area: Area) -> "_Frame":
        # 1200: pixels of the map's longer side
        return cls(area, 1200 * _OVERSAMPLING / max(area.x1 - area.x0, area.y1 - area.y0))

    @property
    def unit(self) -> float:
        """Round length of the grid squares and of the scale bar (m)."""
        return _nice_length(max(self.area.x1 - self.area.x0, self.area.y1 - self.area.y0) / 8)

    @property
    def map_size(self) -> tuple[int, int]:
        return (
            round((self.area.x1 - self.area.x0) * self.scale),
            round((self.area.y1 - self.area.y0) * self.scale),
        )

    @property
    def sheet_size(self) -> tuple[int, int]:
        width, height = self.map_size
        # Narrow maps still leave room for the texts.
        width = max(width, 640 * _OVERSAMPLING)
        return (width + 2 * _MARGIN * _OVERSAMPLING, height + (_HEAD + _FOOT) * _OVERSAMPLING)

    def to_sheet(self, x: int, y: int) -> tuple[int, int]:
        return x + _MARGIN * _OVERSAMPLING, y + _HEAD * _OVERSAMPLING

    def pixel(self, x: float, y: float) -> Point:
        left, top = self.to_sheet(0, 0)
        return left + (x - self.area.x0) * self.scale, top + (self.area.y1 - y) * self.scale


def _shown(raster: OccupancyRaster, paths: list[Array]) -> Area:
    """Return the area of everything seen and travelled, with a margin."""
    seen = ~np.isnan(raster.occupancy())
    corners = [path[:, :2] for path in paths]
    if seen.any():
        rows, columns = np.flatnonzero(seen.any(axis=1)), np.flatnonzero(seen.any(axis=0))
        cells = np.array([[columns[0], rows[0]], [columns[-1] + 1, rows[-1] + 1]])
        corners.append(np.array([raster.area.x0, raster.area.y0]) + cells * raster.cell)
    points = np.vstack(corners) if corners else np.array([[-1.0, -1.0], [1.0, 1.0]])
    around = 0.4  # margin around the area, m
    (x0, y0), (x1, y1) = points.min(axis=0) - around, points.max(axis=0) + around
    return Area(float(x0), float(y0), float(x1), float(y1))


def _background(raster: OccupancyRaster, frame: _Frame) -> Image.Image:
    """Draw the raster in shades from free over unknown to wall, at the size of the map."""
    occupancy = raster.occupancy()
    wall = np.clip(np.nan_to_num(occupancy) * 2.0, 0.0, 1.0)[..., None]
    shades = np.where(np.isnan(occupancy)[..., None], _UNKNOWN, _FREE + (_WALL - _FREE) * wall)
    cells = Image.fromarray(np.flipud(shades).astype(np.uint8))
    canvas = Image.new("RGB", frame.map_size, tuple(_UNKNOWN.astype(int)))
    if cells.width and cells.height:
        size = round(cells.width * raster.cell * frame.scale), round(cells.height * raster.cell * frame.scale)
        corner = frame.pixel(raster.area.x0, raster.area.y1)
        left, top = frame.to_sheet(0, 0)
        canvas.paste(cells.resize(size, Image.Resampling.NEAREST), (round(corner[0] - left), round(corner[1] - top)))
    return canvas


def _rule(canvas: Image.Image, frame: _Frame) -> None:
    """Draw faint lines at round metres, behind the walls."""
    area, step = frame.area, frame.unit
    for x in np.arange(np.ceil(area.x0 / step), np.floor(area.x1 / step) + 1) * step:
        at = round((x - area.x0) * frame.scale)
        _darken(canvas, (at, 0, min(at + _OVERSAMPLING, canvas.width), canvas.height))
    for y in np.arange(np.ceil(area.y0 / step), np.floor(area.y1 / step) + 1) * step:
        at = round((area.y1 - y) * frame.scale)
        _darken(canvas, (0, at, canvas.width, min(at + _OVERSAMPLING, canvas.height)))


def _darken(canvas: Image.Image, box: tuple[int, int, int, int]) -> None:
    strip = canvas.crop(box)
    canvas.paste(ImageChops.darker(strip, Image.new("RGB", strip.size, _RULE)), box[:2])


def _line(pen: ImageDraw.ImageDraw, points: list[Point], style: Style) -> None:
    width = round(style.width * _OVERSAMPLING)
    if style.dash is None:
        pen.line(points, fill=style.color, width=width, joint="curve")
        return
    for dash in _dashes(np.array(points, dtype=np.float64).reshape(-1, 2), style.dash * _OVERSAMPLING):
        pen.line([(x, y) for x, y in dash], fill=style.color, width=width, joint="curve")


def _dashes(points: Array, length: float) -> list[Array]:
    """Return the pieces of a dashed polyline, each ``length`` long, with gaps of 0.7 ``length``."""
    if len(points) < 2:
        return []
    along = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(points, axis=0).T))])
    pieces = []
    for start in np.arange(0.0, along[-1], 1.7 * length):
        end = min(start + length, along[-1])
        stops = np.concatenate([[start], along[(along > start) & (along < end)], [end]])
        pieces.append(np.stack([np.interp(stops, along, points[:, axis]) for axis in (0, 1)], axis=1))
    return pieces


def _ends(pen: ImageDraw.ImageDraw, frame: _Frame, poses: Array, style: Style) -> None:
    """Draw a ring at the start of a path, and an arrow at its end if it has headings."""
    x, y = frame.pixel(*poses[0, :2])
    radius = 6 * _OVERSAMPLING
    pen.ellipse(
        (x - radius, y - radius, x + radius, y + radius), fill=_PAPER, outline=style.color, width=2 * _OVERSAMPLING
    )
    if poses.shape[1] > 2:
        yaw = poses[-1, 2]
        # 0.35: length of the truck's symbol, m
        outline = np.array([[0.6, 0.0], [-0.4, 0.32], [-0.2, 0.0], [-0.4, -0.32]]) * 0.35
        turned = outline @ np.array([[np.cos(yaw), np.sin(yaw)], [-np.sin(yaw), np.cos(yaw)]]) + poses[-1, :2]
        pen.polygon([frame.pixel(*corner) for corner in turned], fill=style.color, outline=_PAPER, width=_OVERSAMPLING)


def _scale_bar(pen: ImageDraw.ImageDraw, frame: _Frame, right: int, bottom: int) -> None:
    """Draw the scale bar, as long as a grid square."""
    length = frame.unit
    end, y, tick = right, bottom + 34 * _OVERSAMPLING, 5 * _OVERSAMPLING
    start = end - round(length * frame.scale)
    width = 2 * _OVERSAMPLING
    pen.line([(start, y), (end, y)], fill=_INK, width=width)
    for x in (start, end):
        pen.line([(x, y - tick), (x, y + tick)], fill=_INK, width=width)
    pen.text(((start + end) / 2, y - 7 * _OVERSAMPLING), f"{length:g} m", fill=_INK, font=_font(15), anchor="mb")


def _legend(pen: ImageDraw.ImageDraw, left: int, bottom: int, rows: list[tuple[str, Style]]) -> None:
    x, y, font = left, bottom + 32 * _OVERSAMPLING, _font(16)
    for name, style in rows:
        _line(pen, [(x, y), (x + 34 * _OVERSAMPLING, y)], style)
        x += 42 * _OVERSAMPLING
        pen.text((x, y), name, fill=_INK, font=font, anchor="lm")
        x += round(pen.textlength(name, font=font)) + 28 * _OVERSAMPLING


def _nice_length(about: float) -> float:
    """Return the largest of 1, 2, 5 times a power of ten that is not longer."""
    power = 10.0 ** np.floor(np.log10(about))
    return float(max(factor * power for factor in (1, 2, 5) if factor * power <= about * 1.0001))


def _font(size: int) -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    return ImageFont.load_default(size * _OVERSAMPLING)
