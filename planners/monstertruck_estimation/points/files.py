"""Points of interest in a map's folder: ``points.json``, and a picture of each."""

from pathlib import Path
from typing import Final

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
    """Write points and pictures; the list last.

    Raises:
        OSError: a file could not be written.
    """
    folder.mkdir(parents=True, exist_ok=True)
    for point, picture in points:
        file = folder / picture_name(point.name)
        if picture and not (file.is_file() and file.read_bytes() == picture):
            replace_file(file, picture)
    replace_file(folder / FILE, _POINTS.dump_json([point for point, _ in points], indent=1))


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
    except (OSError, ValidationError) as error:
        first = str(error).partition("\n")[0]
        raise InputError(f"{file}: not readable as points of interest: {first}") from error
    return [(point, _picture(folder / picture_name(point.name))) for point in points]


def _picture(file: Path) -> bytes:
    try:
        require_file(file, MOST_BYTES)
        return file.read_bytes()
    except OSError:
        return b""
