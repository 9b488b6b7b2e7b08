"""Points of interest of a saved map: ``points.json``, and an image of each point."""

from pathlib import Path
from typing import Final

import numpy as np
from pydantic import TypeAdapter

from monstertruck_kinematics.elementary import Array
from monstertruck_runtime.errors import InputError
from monstertruck_runtime.map_folders import opened, write_save
from monstertruck_runtime.outside import contents_if_present, reading
from monstertruck_runtime.small_files import require_file
from monstertruck_schemas.plan import MAX_COORDINATE
from monstertruck_schemas.points import PointOfInterest

FILE: Final = "points.json"
LARGEST_POINTS_FILE: Final = 5_000_000
_POINTS: Final = TypeAdapter(list[PointOfInterest])


def picture_name(point: str) -> str:
    """Return the file name of a point's image."""
    return f"point-{point}.jpg"


def save(folder: Path, points: list[tuple[PointOfInterest, bytes]], run: str | None = None) -> None:
    """Save points and images with a map; write nothing if there are no points and none were saved before.

    Args:
        folder: folder of the map.
        points: points with their images (JPEG); may be empty.
        run: run that makes the map; None for points of an existing map.

    Raises:
        OSError: a file could not be written.
    """
    parts = {picture_name(point.name): picture for point, picture in points if picture}
    if points or (run is None and load(folder)):
        parts[FILE] = _POINTS.dump_json([point for point, _ in points], indent=1)
    write_save(folder, parts, (FILE, picture_name("*")), run, new=False)


def load(folder: Path) -> list[tuple[PointOfInterest, bytes]]:
    """Return the points of a saved map with their images; empty if it has no points.

    Raises:
        InputError: the file is invalid.
    """
    with opened(folder) as found:
        file = found.file(FILE)
        return [(point, _picture(file.with_name(picture_name(point.name)))) for point in _read(file)]


def _read(file: Path) -> list[PointOfInterest]:
    expected = "points of interest"
    data = contents_if_present(file, expected, LARGEST_POINTS_FILE)
    if data is None:
        return []
    with reading(file, expected):
        points = _POINTS.validate_json(data)
    names = [point.name for point in points]
    for point in points:
        if names.count(point.name) > 1:
            raise InputError(f"{file}: {point.name}: expected unique names")
        if max(map(abs, (point.x, point.y, point.z, point.yaw))) > MAX_COORDINATE:
            raise InputError(f"{file}: {point.name}: expected at most {MAX_COORDINATE:g} m and rad")
        least, most = 1e-12, 1e12  # variance in each direction, m^2 or rad^2
        if not _is_covariance(np.reshape(point.covariance, (3, 3)), least, most):
            text = f"expected a symmetric matrix of variances from {least:g} to {most:g}"
            raise InputError(f"{file}: {point.name}: covariance: {text}")
    return points


def _is_covariance(matrix: Array, least: float, most: float) -> bool:
    if not np.isfinite(matrix).all() or not np.allclose(matrix, matrix.T):
        return False
    smallest, _, largest = np.linalg.eigvalsh(matrix)
    return bool(least <= smallest and largest <= most)


def _picture(file: Path) -> bytes:
    try:
        require_file(file, LARGEST_POINTS_FILE)
        return file.read_bytes()
    except OSError:
        return b""
