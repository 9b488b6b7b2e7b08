"""Points of interest in a map's folder: ``points.json``, and a picture of each."""

from pathlib import Path
from typing import Final

import numpy as np
from pydantic import TypeAdapter, ValidationError

from monstertruck_kinematics.elementary import Array
from monstertruck_runtime.errors import InputError
from monstertruck_runtime.small_files import replace_file, require_file
from monstertruck_schemas.base import first_mistake
from monstertruck_schemas.plan import MAX_COORDINATE
from monstertruck_schemas.points import PointOfInterest

FILE: Final = "points.json"
MOST_BYTES: Final = 5_000_000
VARIANCES: Final = (1e-12, 1e12)
"""The least and the greatest one of any direction that is taken from a file, m^2 or rad^2."""
_POINTS: Final = TypeAdapter(list[PointOfInterest])


def picture_name(point: str) -> str:
    """File of a point's picture."""
    return f"point-{point}.jpg"


def save(folder: Path, points: list[tuple[PointOfInterest, bytes]]) -> None:
    """Write points and pictures, then the list; pictures of other points go.

    Raises:
        OSError: a file could not be written.
    """
    folder.mkdir(parents=True, exist_ok=True)
    for point, picture in points:
        file = folder / picture_name(point.name)
        if picture and not (file.is_file() and file.read_bytes() == picture):
            replace_file(file, picture)
    replace_file(folder / FILE, _POINTS.dump_json([point for point, _ in points], indent=1))
    pictured = {picture_name(point.name) for point, picture in points if picture}
    for file in folder.glob(picture_name("*")):
        if file.name not in pictured:
            file.unlink(missing_ok=True)


def load(folder: Path) -> list[tuple[PointOfInterest, bytes]]:
    """Points of a map's folder, with their pictures; none if it has none.

    Raises:
        InputError: the file is not what it should be.
    """
    file = folder / FILE
    if not file.is_file():
        return []
    try:
        require_file(file, MOST_BYTES)
        points = _POINTS.validate_json(file.read_bytes())
    except OSError as error:
        raise InputError(f"{file}: not readable as points of interest: {error.strerror or error}") from error
    except ValidationError as error:
        raise InputError(f"{file}: not readable as points of interest: {first_mistake(error)}") from error
    names = [point.name for point in points]
    for point in points:
        if names.count(point.name) > 1:
            raise InputError(f"{file}: {point.name}: expected every name once")
        if max(map(abs, (point.x, point.y, point.z, point.yaw))) > MAX_COORDINATE:
            raise InputError(f"{file}: {point.name}: expected at most {MAX_COORDINATE:g} m and rad")
        if not _is_covariance(np.reshape(point.covariance, (3, 3))):
            least, most = VARIANCES
            text = f"expected a symmetric matrix of variances from {least:g} to {most:g}"
            raise InputError(f"{file}: {point.name}: covariance: {text}")
    return [(point, _picture(folder / picture_name(point.name))) for point in points]


def _is_covariance(matrix: Array) -> bool:
    if not np.isfinite(matrix).all() or not np.allclose(matrix, matrix.T):
        return False
    least, _, most = np.linalg.eigvalsh(matrix)
    return bool(VARIANCES[0] <= least and most <= VARIANCES[1])


def _picture(file: Path) -> bytes:
    try:
        require_file(file, MOST_BYTES)
        return file.read_bytes()
    except OSError:
        return b""
