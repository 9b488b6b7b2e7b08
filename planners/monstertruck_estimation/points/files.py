"""Points of interest in a map's folder: ``points.json``, and a picture of each."""

from pathlib import Path
from typing import Final

import numpy as np
from pydantic import TypeAdapter, ValidationError

from monstertruck_runtime.errors import InputError
from monstertruck_runtime.small_files import replace_file, require_file
from monstertruck_schemas.points import PointOfInterest

FILE: Final = "points.json"
MOST_BYTES: Final = 5_000_000
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
        first = error.errors(include_url=False)[0]
        place = ".".join(map(str, first["loc"]))
        raise InputError(
            f"{file}: not readable as points of interest: {place}{': ' if place else ''}{first['msg']}"
        ) from error
    names = [point.name for point in points]
    for point in points:
        covariance = np.reshape(point.covariance, (3, 3))
        if names.count(point.name) > 1:
            raise InputError(f"{file}: {point.name}: expected every name once")
        if not np.allclose(covariance, covariance.T) or np.linalg.eigvalsh(covariance).min() <= 0.0:
            raise InputError(f"{file}: {point.name}: covariance: expected a symmetric matrix of positive variances")
    return [(point, _picture(folder / picture_name(point.name))) for point in points]


def _picture(file: Path) -> bytes:
    try:
        require_file(file, MOST_BYTES)
        return file.read_bytes()
    except OSError:
        return b""
