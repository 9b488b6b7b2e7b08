"""Occupancy maps in the map_server format: a YAML file that refers to an image.

Unlike in the image, row 0 of the array is the lowest y, so cell (row, column) covers
``origin + resolution * ([column, column + 1], [row, row + 1])``.
"""

import hashlib
import io
import math
import os
import re
import sys
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from PIL import Image, TiffImagePlugin

from monstertruck_runtime.errors import InputError
from monstertruck_runtime.map_folders import YAML, MapSave, folder_of, opened
from monstertruck_runtime.outside import MOST_PIXELS, picture, reading
from monstertruck_runtime.small_files import remove_file, replace_file
from monstertruck_runtime.yaml_files import read_yaml, yaml_text

FREE, OCCUPIED, UNKNOWN = 0, 100, -1
"""Cell values, as in an occupancy grid message."""
OCCUPIED_FROM, FREE_TO = 65, 19
"""Thresholds of map_server (percent): a cell is occupied from the first on, free up to the second."""
MOST_CELLS: Final = MOST_PIXELS
"""Cells of a map at most: 250 m a side at 5 cm."""

_REQUIRED = ("image", "resolution", "origin", "negate", "occupied_thresh", "free_thresh")
_MODES = ("trinary", "scale", "raw")
_BAND: Final = 1_000_000
"""Number of pixels converted at once."""


@dataclass(frozen=True, slots=True, eq=False)
class WorldMap:
    """An occupancy map, axis-aligned with the map frame.

    Args:
        cells: int8 (rows, columns), ``FREE`` to ``OCCUPIED`` percent or ``UNKNOWN``; row 0 is the lowest y; read-only.
        resolution: side of a cell, m.
        origin: x, y of the outer corner of cell (0, 0), m.
        others: other keys of its YAML file; ``save_map`` writes them back.
        remarks: warnings about its files.
    """

    cells: NDArray[np.int8]
    resolution: float
    origin: tuple[float, float] = (0.0, 0.0)
    others: Mapping[str, Any] = field(default_factory=dict)
    remarks: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        cells = np.array(self.cells, dtype=np.int8, order="C")
        cells.flags.writeable = False
        object.__setattr__(self, "cells", cells)

    @property
    def size(self) -> tuple[float, float]:
        """Extent in x and y, m."""
        rows, columns = self.cells.shape
        return columns * self.resolution, rows * self.resolution

    def trinary(self) -> "WorldMap":
        """The map with cells of ``FREE``, ``OCCUPIED`` and ``UNKNOWN`` only."""
        cells = np.full(self.cells.shape, UNKNOWN, np.int8)
        cells[self.cells >= OCCUPIED_FROM] = OCCUPIED
        cells[(self.cells >= 0) & (self.cells <= FREE_TO)] = FREE
        return replace(self, cells=cells)


def load_map(path: Path) -> WorldMap:
    """Read a map_server YAML file and its image, or the latest intact save in the folder of a map.

    Cells have the values that nav2's map_server publishes. With p = darkness in 0..1 (lightness if ``negate``), p >
    occupied_thresh is occupied, p < free_thresh free, the rest unknown. ``mode: scale`` spreads the rest over 0..100,
    and makes transparent pixels unknown; ``mode: raw`` uses the lightness in 255ths as percent. Colours are averaged
    over their channels, to which ``mode: trinary`` adds alpha. A yaw of the origin rotates the cells into the map
    frame.

    The image path is relative to the YAML file, absolute, or starts with ``~``. If an absolute path does not exist, the
    file of the same name next to the YAML file is read.

    Raises:
        InputError: invalid content; the message names file, key and expected value.
    """
    folder = folder_of(path)
    if folder is None:
        return _guarded(path)
    with opened(folder) as save:
        return load_saved(save)


def load_saved(save: MapSave) -> WorldMap:
    """Read the grid of an open save; its remarks are added to the map's.

    Raises:
        InputError: see ``load_map``.
    """
    world = _guarded(save.file(YAML))
    return replace(world, remarks=save.remarks + world.remarks)


def _guarded(path: Path) -> WorldMap:
    with reading(path, "a map"):
        return _load(path)


def _load(path: Path) -> WorldMap:
    keys, others = _read_keys(path)
    cells = np.flipud(_read_image(path, _image_of(path, keys["image"]), keys))
    (x, y, yaw), resolution = keys["origin"], float(keys["resolution"])
    origin = (float(x), float(y))
    if yaw:
        try:
            cells, origin = turned(cells, resolution, (*origin, float(yaw)))
        except ValueError as error:
            raise InputError(f"{path}: origin: {error}") from error
    remarks = [f"{path}: {key}: unknown key, left unchanged" for key in others]
    if not (cells >= OCCUPIED_FROM).any():
        remarks.append(f"{path}: no occupied cell: check image, negate and the thresholds")
    return WorldMap(cells, resolution, origin, others, tuple(remarks))


def files_of(place: Path) -> list[Path]:
    """Return the files of a map that ``load_map`` needs: those of the latest intact save, or YAML and image.

    An image with an absolute path in the YAML is not included.

    Raises:
        InputError: see ``load_map``.
    """
    folder = folder_of(place)
    if folder is None:
        keys, _ = _read_keys(place)
        image = _image_of(place, keys["image"])
        return [place] if Path(keys["image"]).is_absolute() and image.exists() else [place, image]
    with opened(folder) as save:
        kept = [save.folder] if save.beside is None else [save.folder, save.beside]
        return [file for part in kept for file in sorted(part.iterdir()) if file.is_file()]


def turned(
    cells: NDArray[np.int8], resolution: float, origin: tuple[float, float, float]
) -> tuple[NDArray[np.int8], tuple[float, float]]:
    """Resample a grid whose lower left corner has the pose ``origin`` (x, y in m, yaw in rad) to axis-aligned cells.

    Every cell takes the value of the cell that contains its centre. Every occupied cell occupies the cell that contains
    its own centre, so that no wall is lost.

    Returns:
        New cells, int8 (rows, columns), and x, y of their outer corner, m.

    Raises:
        ValueError: there would be more than ``MOST_CELLS``.
    """
    x, y, yaw = origin
    along = np.array((math.cos(yaw), math.sin(yaw)))
    across = np.array((-along[1], along[0]))
    rows, columns = cells.shape
    corners = np.array([a * along + b * across for a in (0, columns) for b in (0, rows)])
    low = np.floor(np.round(corners.min(axis=0), 6))
    width, height = (np.ceil(np.round(corners.max(axis=0), 6)) - low).astype(int).tolist()
    if width * height > MOST_CELLS:
        raise ValueError(f"{width} x {height} cells along the map's axes, expected at most {MOST_CELLS}")
    new = np.full((height, width), UNKNOWN, np.int8)
    for first in range(0, height, step := max(_BAND // width, 1)):
        row, column = np.mgrid[first : min(first + step, height), 0:width]
        there = np.stack((column + low[0] + 0.5, row + low[1] + 0.5), axis=-1)
        i, j = np.floor(there @ across).astype(int), np.floor(there @ along).astype(int)
        inside = (i >= 0) & (i < rows) & (j >= 0) & (j < columns)
        new[row[inside], column[inside]] = cells[i[inside], j[inside]]
    i, j = np.nonzero(cells >= OCCUPIED_FROM)
    to = np.floor((j[:, None] + 0.5) * along + (i[:, None] + 0.5) * across - low).astype(int)
    np.maximum.at(new, (to[:, 1], to[:, 0]), cells[i, j])
    return new, (x + float(low[0]) * resolution, y + float(low[1]) * resolution)


def save_map(world: WorldMap, path: Path) -> None:
    """Write ``path`` (YAML) and a grey PNG of the same stem; ``load_map`` reads back the trinary map.

    The YAML file is replaced last, so it never refers to the image of another map: if a different image has the PNG's
    name, the new one gets another name, and the old image is removed at the end.

    Raises:
        OSError: a file could not be written; the previous map is kept.
    """
    _, picture = map_content(world, "")
    image = path.with_suffix(".png")
    if os.path.lexists(image) and not (image.is_file() and image.read_bytes() == picture):
        image = path.with_name(f"{path.stem}-{hashlib.sha256(picture).hexdigest()[:8]}.png")
    before = _picture_of(path)
    replace_file(image, picture)
    replace_file(path, map_content(world, image.name)[0])
    if before is not None and before != image.name:
        remove_file(path.with_name(before))


def _picture_of(path: Path) -> str | None:
    """Name of the image that ``save_map`` wrote for a YAML file; None if it wrote none."""
    try:
        name = str(_read_keys(path)[0]["image"])
    except InputError:
        return None
    return name if re.fullmatch(rf"{re.escape(path.stem)}(-[0-9a-f]{{8}})?\.png", name) else None


def map_content(world: WorldMap, image: str) -> tuple[str, bytes]:
    """Return the YAML text of a map whose image is named ``image``, and the image (PNG)."""
    shades = np.full(world.cells.shape, 205, dtype=np.uint8)
    shades[(world.cells >= 0) & (world.cells <= FREE_TO)] = 254
    shades[world.cells >= OCCUPIED_FROM] = 0
    picture = io.BytesIO()
    Image.fromarray(np.flipud(shades)).save(picture, "PNG", optimize=True)
    keys = {
        "image": image,
        "mode": "trinary",
        "resolution": world.resolution,
        "origin": [*world.origin, 0.0],
        "negate": 0,
        "occupied_thresh": 0.65,
        "free_thresh": 0.196,
    }
    return yaml_text(keys | dict(world.others)), picture.getvalue()


def _read_keys(path: Path) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return the validated keys of map_server, and the other keys."""
    no_map = f"{path}: not a map: expected the folder of a saved map, or a map_server YAML"
    try:
        keys = read_yaml(path)
    except InputError as error:
        if path.is_file():
            raise InputError(f"{no_map} ({error})") from error
        raise
    if not isinstance(keys, dict) or keys.keys().isdisjoint(_REQUIRED):
        raise InputError(f"{no_map} with the keys {', '.join(_REQUIRED)}")
    others = {str(key): value for key, value in keys.items() if key not in {*_REQUIRED, "mode"}}
    for key in _REQUIRED:
        if key not in keys:
            raise InputError(f"{path}: {key}: missing")
    keys.setdefault("mode", "trinary")
    _check_values(path, keys)
    return keys, others


def _check_values(path: Path, keys: dict[str, Any]) -> None:
    def refuse(key: str, expected: str) -> InputError:
        return InputError(f"{path}: {key}: expected {expected}, got {keys[key]!r}")

    if not (isinstance(keys["image"], str) and keys["image"]):
        raise refuse("image", "a file name")
    if not (_is_number(keys["resolution"]) and keys["resolution"] > 0):
        raise refuse("resolution", "metres per cell > 0")
    origin = keys["origin"]
    if not (isinstance(origin, list) and len(origin) == 3 and all(map(_is_number, origin))):
        raise refuse("origin", "[x, y, yaw]")
    if keys["negate"] not in (0, 1):
        raise refuse("negate", "0 or 1")
    for key in ("occupied_thresh", "free_thresh"):
        if not (_is_number(keys[key]) and 0 <= keys[key] <= 1):
            raise refuse(key, "a number in 0..1")
    if keys["free_thresh"] >= keys["occupied_thresh"]:
        raise refuse("free_thresh", "less than occupied_thresh")
    if keys["mode"] not in _MODES:
        raise refuse("mode", f"one of {', '.join(_MODES)}")


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= sys.float_info.max


def _image_of(source: Path, name: str) -> Path:
    """Path of the image named by a YAML file."""
    try:
        there = Path(name).expanduser()
    except RuntimeError:  # no such user
        there = Path(name)
    beside = source.parent / there.name
    if there.is_absolute():
        return there if there.exists() or not beside.exists() else beside
    return source.parent / there


def _read_image(source: Path, path: Path, keys: Mapping[str, Any]) -> NDArray[np.int8]:
    """Cells of an image by the rules of map_server, top row first."""
    try:
        with picture(path, "the picture of a map") as image:
            return _cells(*pixels(image), keys)
    except InputError as error:
        raise InputError(f"{source}: image: {error}") from error


@dataclass(frozen=True, slots=True)
class Shades:
    """Convert pixels to numbers: lightness = mean over channels of ``levels / full``."""

    levels: NDArray[Any]
    """Shape (rows, columns) or (rows, columns, channels)."""
    full: float
    """Level of white."""


def pixels(image: Image.Image) -> tuple[Shades, NDArray[np.uint8] | None]:
    """Lightness and alpha of an image in any of Pillow's modes.

    Returns:
        Grey levels or colours, and alpha (rows, columns), 0 transparent to 255; None: opaque.

    Raises:
        OSError, ValueError, and others: Pillow cannot decode or convert it.
    """
    if image.mode.startswith("I") or image.mode == "F":
        levels, full = np.asarray(image), _white(image)
        hidden = image.info.get("transparency")
        alpha = None if hidden is None else np.where(levels == hidden, 0, 255).astype(np.uint8)
        tags = image.tag_v2 if isinstance(image, TiffImagePlugin.TiffImageFile) else {}
        if tags.get(TiffImagePlugin.PHOTOMETRIC_INTERPRETATION) == 0:  # white is zero
            levels = full - levels.astype(np.float64)
        return Shades(levels, full), alpha
    if image.has_transparency_data:
        seen = np.asarray((image.convert("LA") if image.mode == "La" else image).convert("RGBA"))
        return Shades(seen[..., :3], 255.0), seen[..., 3]
    if image.mode in ("1", "L"):
        return Shades(np.asarray(image.convert("L")), 255.0), None
    return Shades(np.asarray(image.convert("RGB")), 255.0), None


def _white(image: Image.Image) -> float:
    """Level of white in an image with one channel of numbers."""
    if image.mode == "F":
        return 1.0
    if not isinstance(image, TiffImagePlugin.TiffImageFile):
        return 65535.0
    bits = image.tag_v2.get(TiffImagePlugin.BITSPERSAMPLE, (16,))[0]
    signed = image.tag_v2.get(TiffImagePlugin.SAMPLEFORMAT, (1,))[0] == 2
    return float(2 ** (bits - signed) - 1)


def _cells(shades: Shades, alpha: NDArray[np.uint8] | None, keys: Mapping[str, Any]) -> NDArray[np.int8]:
    """Values of nav2's map_server for pixels.

    Raises:
        ValueError: levels beyond white.
    """
    mode, occupied, free = keys["mode"], keys["occupied_thresh"], keys["free_thresh"]
    rows, columns = shades.levels.shape[:2]
    cells = np.full((rows, columns), UNKNOWN, np.int8)
    for first in range(0, rows, step := max(_BAND // max(columns, 1), 1)):
        band = slice(first, first + step)
        levels = shades.levels[band].astype(np.float64)
        if levels.ndim == 2:
            levels = levels[..., None]
        if np.nanmax(levels, initial=0.0) > shades.full or np.nanmin(levels, initial=0.0) < 0.0:
            raise ValueError(f"levels {np.nanmin(levels):g} to {np.nanmax(levels):g}, expected 0 to {shades.full:g}")
        if alpha is not None and mode == "trinary":
            if levels.shape[-1] == 1:
                levels = np.repeat(levels, 3, axis=-1)
            levels = np.concatenate((levels, alpha[band, :, None] * (shades.full / 255.0)), axis=-1)
        lightness = levels.sum(axis=-1) / levels.shape[-1] / shades.full
        into = cells[band]
        if mode == "raw":
            percent = np.floor(lightness * 255.0 + 0.5)
            known = percent <= OCCUPIED
            into[known] = percent[known].astype(np.int8)
            continue
        darkness = lightness if keys["negate"] else 1.0 - lightness
        if mode == "scale":
            known = np.isfinite(darkness)
            between = np.rint((darkness[known] - free) / (occupied - free) * OCCUPIED)
            into[known] = np.clip(between, FREE, OCCUPIED).astype(np.int8)
        into[darkness > occupied] = OCCUPIED
        into[darkness < free] = FREE
        if mode == "scale" and alpha is not None:
            into[alpha[band] < 255] = UNKNOWN
    return cells
