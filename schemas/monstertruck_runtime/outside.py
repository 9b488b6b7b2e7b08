"""Readers of external files: maps, images, arrays, tables, logs, certificates, files of earlier runs.

A reader opens its file with one of the functions here, or works inside ``reading``. Every failure in any library is
then converted to one of our errors, which names the file, the expected content and the finding. Sizes are bounded
before anything is decompressed or loaded.
"""

import gzip
import re
import warnings
import xml.etree.ElementTree as ET
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from monstertruck_runtime.errors import InputError, TruckError
from monstertruck_runtime.small_files import MEGABYTE, require_file
from monstertruck_schemas.base import first_mistake

if TYPE_CHECKING:
    from PIL import Image

MOST_UNPACKED: Final = 128 * MEGABYTE
"""Maximum size of a compressed file or compressed part, decompressed (bytes)."""
MOST_PIXELS: Final = 25 * MEGABYTE
"""Maximum pixels of an image: 250 m x 250 m in cells of 5 cm."""
FORMATS: Final = ("PNG", "PPM", "BMP", "JPEG", "TIFF", "GIF", "WEBP")
"""Formats of pictures that are read; Pillow decodes others by starting programs."""


@contextmanager
def reading(file: Path | str, expected: str, refusal: type[TruckError] = InputError) -> Iterator[None]:
    """Convert any exception in the body to an error about ``file``; our own errors pass unchanged.

    Args:
        file: path, or path and place in it, for the message.
        expected: expected content, e.g. "a pose graph".
        refusal: class of the error.
    """
    try:
        yield
    except TruckError:
        raise
    except OSError as error:
        if error.errno is None:  # a library's error about the content
            raise refusal(f"{file}: expected {expected}: {cause_of(error)}") from error
        raise refusal(f"{file}: cannot be read: {error.strerror or error}") from error
    except Exception as error:
        raise refusal(f"{file}: expected {expected}: {cause_of(error)}") from error


def quoted(text: str) -> str:
    """Return an external text as one line, short enough for an error message."""
    return " ".join(text.split())[:200]


def cause_of(error: BaseException) -> str:
    """Format an error of a library as one line."""
    if isinstance(error, ValidationError):
        return first_mistake(error)
    if isinstance(error, MemoryError):
        return "there is not enough memory for it"
    if isinstance(error, RecursionError):
        return "it is nested too deeply"
    text = quoted(str(error))
    if text and isinstance(error, ValueError | OSError):
        return text
    return f"{type(error).__name__}: {text}" if text else type(error).__name__


def contents(file: Path, expected: str, most: int, refusal: type[TruckError] = InputError) -> bytes:
    """Read a whole file of at most ``most`` bytes.

    Raises:
        TruckError: ``refusal``: it cannot be read, is not a regular file, or is too large.
    """
    with reading(file, expected, refusal):
        require_file(file, most)
        with file.open("rb") as stream:
            return stream.read(most)


def contents_if_present(file: Path, expected: str, most: int, refusal: type[TruckError] = InputError) -> bytes | None:
    """Read a whole file of at most ``most`` bytes; return None only if its folder has no such name.

    A link whose target is missing counts as damaged: its content exists elsewhere, for example on a disk that is not
    mounted.

    Raises:
        TruckError: ``refusal``: as for ``contents``.
    """
    with reading(file, expected, refusal):
        try:
            file.lstat()
        except FileNotFoundError:
            return None
    return contents(file, expected, most, refusal)


def text_of(file: Path, expected: str, most: int, refusal: type[TruckError] = InputError) -> str:
    """Read a whole text file of at most ``most`` bytes: UTF-8, with or without a byte order mark.

    Raises:
        TruckError: ``refusal``: as for ``contents``, or it is not UTF-8.
    """
    return text_from(contents(file, expected, most, refusal), file, expected, refusal)


def text_from(data: bytes, file: Path, expected: str, refusal: type[TruckError] = InputError) -> str:
    """Decode the content of ``file``: UTF-8, with or without a byte order mark.

    Raises:
        TruckError: ``refusal``: it is not UTF-8; the message names the line.
    """
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = data.count(b"\n", 0, error.start) + 1
        raise refusal(f"{file}:{line}: expected {expected}: not UTF-8 text") from error


def xml_from(text: str, file: Path, expected: str) -> ET.Element:
    """Parse XML without declarations of entities, which could expand to any size.

    Raises:
        InputError: it is not XML, or declares entities.
    """
    if "<!" in re.sub(r"<!--.*?-->|<!DOCTYPE\s+\w+\s*>", "", text, flags=re.DOTALL):
        raise InputError(f"{file}: declares entities: expected {expected} without them")
    with reading(file, expected):
        return ET.fromstring(text)  # noqa: S314 - without entities


def lines_of(file: Path, expected: str, most: int = MOST_UNPACKED) -> Iterator[str]:
    """Yield the lines of a text file, unpacked if its name ends with ``.gz``.

    Raises:
        InputError: it cannot be read, is not UTF-8, is damaged, or contains more than ``most`` bytes.
    """
    with reading(file, expected):
        require_file(file)
        packed = file.suffix == ".gz"
        left, number = most, 0
        with gzip.open(file) if packed else file.open("rb") as stream:
            while line := stream.readline(left + 1):
                left, number = left - len(line), number + 1
                if left < 0:
                    text = f"more than {most / MEGABYTE:.0f} MB{' unpacked' if packed else ''}: expected at most that"
                    raise InputError(f"{file}:{number}: {text}")
                try:
                    yield line.decode("utf-8-sig" if number == 1 else "utf-8")
                except UnicodeDecodeError as error:
                    raise InputError(f"{file}:{number}: expected {expected}: not UTF-8 text") from error


def arrays(
    file: Path, expected: str, most: int = MOST_UNPACKED, refusal: type[TruckError] = InputError
) -> dict[str, NDArray[Any]]:
    """Read all arrays of an npz file, by name.

    Raises:
        TruckError: ``refusal``: it cannot be read, is damaged, contains objects, or more than ``most`` bytes.
    """
    with reading(file, expected, refusal):
        require_file(file)
        with zipfile.ZipFile(file) as archive:
            size = sum(entry.file_size for entry in archive.infolist())
            if size > most:
                raise refusal(f"{file}: {size} bytes unpacked: expected at most {most}")
            found = {}
            for entry in archive.infolist():
                if entry.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
                    raise refusal(f"{file}: {entry.filename}: expected arrays as NumPy packs them")
                with archive.open(entry) as stream:
                    _require_array(stream, entry.file_size)
                    stream.seek(0)
                    found[entry.filename.removesuffix(".npy")] = np.lib.format.read_array(stream, allow_pickle=False)
            return found


def _require_array(stream: Any, size: int) -> None:
    """Reject the header of an array that does not fit into ``size`` bytes, for which NumPy would allocate memory.

    Raises:
        ValueError: it is not an array, contains objects, or is too large.
    """
    version = np.lib.format.read_magic(stream)
    read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    shape, _, kind = read(stream)
    count = int(np.prod(shape, dtype=object))
    if min(shape, default=0) < 0 or count * kind.itemsize > size:
        raise ValueError(f"an array of shape {shape} in {size} bytes")


@contextmanager
def picture(file: Path, expected: str = "a picture") -> Iterator["Image.Image"]:
    """Open an image in one of ``FORMATS``; its pixels are decoded on access.

    Raises:
        InputError: it cannot be read, is of an unknown format, or has too many pixels; in the body: any decoding
            error.
    """
    from PIL import Image  # noqa: PLC0415 - only for pictures

    with reading(file, expected):
        require_file(file)
        try:
            with warnings.catch_warnings(action="error", category=Image.DecompressionBombWarning):
                image = Image.open(file, formats=FORMATS)
        except (Image.DecompressionBombWarning, Image.DecompressionBombError) as error:
            size = str(error).partition(" exceeds")[0]
            raise InputError(f"{file}: {size}: expected at most {MOST_PIXELS} pixels") from error
        with image:
            require_pixels(file, image.width, image.height)
            yield image


def require_pixels(name: object, width: float, height: float) -> None:
    """Reject an image of more than ``MOST_PIXELS``.

    Raises:
        InputError: it has more.
    """
    if width * height > MOST_PIXELS:
        raise InputError(f"{name}: {width:.0f} x {height:.0f} pixels: expected at most {MOST_PIXELS}")
