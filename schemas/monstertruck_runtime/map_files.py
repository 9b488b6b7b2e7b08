"""Occupancy maps in the map_server format: one YAML file that names one image.

The array's convention differs from the image's: row 0 is the lowest y, so cell (row, column) covers
``origin + resolution * ([column, column + 1], [row, row + 1])``.
"""

import io
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, UnidentifiedImageError

from monstertruck_runtime.errors import InputError
from monstertruck_runtime.small_files import replace_file
from monstertruck_runtime.yaml_files import read_yaml, yaml_text

FREE, OCCUPIED, UNKNOWN = 0, 100, -1
"""Cell values, as in an occupancy grid message."""
YAML = "map.yaml"
"""Name of the file in the folder of a saved map."""

_REQUIRED = ("image", "resolution", "origin", "negate", "occupied_thresh", "free_thresh")
_MODES = ("trinary", "scale", "raw")


@dataclass(frozen=True, slots=True, eq=False)
class WorldMap:
    """A ternary occupancy map, axis-aligned with the map frame.

    Args:
        cells: int8 (rows, columns) of ``FREE``, ``OCCUPIED`` or ``UNKNOWN``; row 0 is the lowest y; read-only.
        resolution: side of a cell, m.
        origin: x, y of the outer corner of cell (0, 0), m.
    """

    cells: NDArray[np.int8]
    resolution: float
    origin: tuple[float, float] = (0.0, 0.0)

    def __post_init__(self) -> None:
        cells = np.array(self.cells, dtype=np.int8, order="C")
        cells.flags.writeable = False
        object.__setattr__(self, "cells", cells)

    @property
    def size(self) -> tuple[float, float]:
        """Extent in x and y, m."""
        rows, columns = self.cells.shape
        return columns * self.resolution, rows * self.resolution


def load_map(path: Path) -> WorldMap:
    """Read a map_server YAML file, or the one in a folder of ours, and the image it names (relative to the YAML).

    Thresholds apply as in map_server: with p = darkness in 0..1 (lightness if ``negate``), p > occupied_thresh
    is occupied, p < free_thresh free, the rest unknown. ``mode: raw`` takes the pixel value itself as percent.
    Colour images count by the mean of their colours; alpha matters only in ``mode: scale``: transparent is unknown.

    Raises:
        InputError: file, key and expectation of whatever is wrong.
    """
    if path.is_dir():
        path /= YAML
    keys = _read_keys(path)
    sums, opaque = _read_image(path, path.parent / str(keys["image"]))
    mode, values = keys["mode"], np.arange(3 * 255 + 1) / 3.0
    if mode == "raw":
        darkness = np.where(values <= 100, values / 100.0, np.nan)
    else:
        darkness = values / 255.0 if keys["negate"] else (255.0 - values) / 255.0
    cell_of = np.full(values.shape, UNKNOWN, dtype=np.int8)
    cell_of[darkness > keys["occupied_thresh"]] = OCCUPIED
    cell_of[darkness < keys["free_thresh"]] = FREE
    cells = cell_of[sums]
    if mode == "scale" and opaque is not None:
        cells[~opaque] = UNKNOWN
    return WorldMap(np.flipud(cells), keys["resolution"], (keys["origin"][0], keys["origin"][1]))


def save_map(world: WorldMap, path: Path) -> None:
    """Write ``path`` (YAML) and a grey PNG of the same stem in the same folder; ``load_map`` reads back an equal map.

    Raises:
        OSError: a file could not be written; the YAML is the last one.
    """
    shades = np.full(world.cells.shape, 205, dtype=np.uint8)
    shades[world.cells == FREE] = 254
    shades[world.cells == OCCUPIED] = 0
    image = path.with_suffix(".png")
    picture = io.BytesIO()
    Image.fromarray(np.flipud(shades)).save(picture, "PNG", optimize=True)
    replace_file(image, picture.getvalue())
    keys = {
        "image": image.name,
        "mode": "trinary",
        "resolution": world.resolution,
        "origin": [*world.origin, 0.0],
        "negate": 0,
        "occupied_thresh": 0.65,
        "free_thresh": 0.196,
    }
    replace_file(path, yaml_text(keys))


def _read_keys(path: Path) -> dict[str, Any]:
    no_map = f"{path}: no map: expected the folder of a saved map, or a map_server YAML"
    try:
        keys = read_yaml(path)
    except InputError as error:
        if path.is_file():
            raise InputError(f"{no_map} ({error})") from error
        raise
    if not isinstance(keys, dict) or keys.keys().isdisjoint(_REQUIRED):
        raise InputError(f"{no_map} with the keys {', '.join(_REQUIRED)}")
    if unknown := sorted(str(key) for key in keys.keys() - {*_REQUIRED, "mode"}):
        raise InputError(f"{path}: {unknown[0]}: unknown key; known are {', '.join(_REQUIRED)}, mode")
    for key in _REQUIRED:
        if key not in keys:
            raise InputError(f"{path}: {key}: missing")
    keys.setdefault("mode", "trinary")
    _check_values(path, keys)
    return keys


def _check_values(path: Path, keys: dict[str, Any]) -> None:
    def refuse(key: str, expected: str) -> InputError:
        return InputError(f"{path}: {key}: expected {expected}, got {keys[key]!r}")

    if not isinstance(keys["image"], str):
        raise refuse("image", "a file name")
    if not (_is_number(keys["resolution"]) and keys["resolution"] > 0):
        raise refuse("resolution", "metres per cell > 0")
    origin = keys["origin"]
    if not (isinstance(origin, list) and len(origin) == 3 and all(map(_is_number, origin))):
        raise refuse("origin", "[x, y, yaw]")
    if origin[2] != 0:
        raise refuse("origin", "yaw 0 (turned maps are not supported)")
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
    return isinstance(value, int | float) and not isinstance(value, bool) and bool(np.isfinite(value))


def _read_image(source: Path, path: Path) -> tuple[NDArray[np.uint16], NDArray[np.bool_] | None]:
    """Sums of the three colours, each 0..255, and opacity (None: all of it), both (rows, columns), top row first."""
    try:
        with Image.open(path) as image:
            if image.mode in ("1", "L") and "transparency" not in image.info:
                return np.asarray(image.convert("L"), np.uint16) * 3, None
            pixels = np.asarray(image.convert("RGBA"))
    except UnidentifiedImageError as error:
        raise InputError(f"{source}: image: {path} is not a known image format") from error
    except OSError as error:
        raise InputError(f"{source}: image: cannot read {path}: {error}") from error
    return pixels[..., :3].sum(axis=-1, dtype=np.uint16), pixels[..., 3] > 0
