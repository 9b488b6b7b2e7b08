"""Records of an MCAP file as they stand there, and its index: what no flipped bit may pass unseen."""

import os
import struct
import zlib
from io import BytesIO
from pathlib import Path
from typing import BinaryIO, Final

import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import EndOfFile, McapError
from mcap.opcode import Opcode
from mcap.records import Statistics

MAGIC: Final = b"\x89MCAP0\r\n"

DAMAGE: Final = (
    McapError,
    zstandard.ZstdError,
    struct.error,
    ValueError,
    RuntimeError,
    LookupError,
    MemoryError,
    OverflowError,
    OSError,
)
"""What the libraries raise on bytes that are no MCAP record (lz4: RuntimeError; bad checksums: ValueError)."""

_END: Final = struct.Struct("<BQQQI8s")
"""Footer and magic: opcode, length, where the summary and its offsets begin, checksum."""

_FOOTER_LENGTH: Final = struct.calcsize("<QQI")
_UNSUMMED: Final = struct.calcsize("<I8s")
_HEAD: Final = struct.Struct("<BQ")
"""Of a record: opcode, length of the content."""
CHECKSUM: Final = struct.Struct("<I")
_PIECE: Final = 1 << 20


def is_finished(path: Path) -> bool:
    """Whether the file ends as a finished log does."""
    with path.open("rb") as file:
        size = file.seek(0, os.SEEK_END)
        file.seek(-min(size, len(MAGIC)), os.SEEK_END)
        return size > len(MAGIC) and file.read() == MAGIC


def index_is_sound(file: BinaryIO) -> bool:
    """Whether a log is finished, and its index at the end, if it has one, is what the checksum says.

    Args:
        file: of the log; its position is another one afterwards.
    """
    size = file.seek(0, os.SEEK_END)
    file.seek(-min(size, _END.size), os.SEEK_END)
    end = file.read()
    if len(end) < _END.size:
        return False
    opcode, length, start, _, checksum, magic = _END.unpack(end)
    if (opcode, length, magic) != (Opcode.FOOTER, _FOOTER_LENGTH, MAGIC) or start > size - _END.size:
        return False
    return not (start and checksum) or _checksum(file, start, size - _UNSUMMED) == checksum


def _checksum(file: BinaryIO, begin: int, end: int) -> int:
    """Of the bytes from ``begin`` up to ``end``, which may be more than fit into memory."""
    file.seek(begin)
    value = 0
    for at in range(begin, end, _PIECE):
        value = zlib.crc32(file.read(min(_PIECE, end - at)), value)
    return value


def read_frame(file: BinaryIO, size: int) -> tuple[int, bytes, bytes]:
    """Opcode, head and content of the next record of a file of ``size`` bytes.

    Raises:
        EndOfFile: it is not all there.
    """
    head = file.read(_HEAD.size)
    if len(head) < _HEAD.size:
        raise EndOfFile
    opcode, length = _HEAD.unpack(head)
    if length > size - file.tell():
        raise EndOfFile
    return opcode, head, file.read(length)


def read_statistics(file: BinaryIO, size: int) -> Statistics | None:
    """Of a sound index that begins where ``file`` stands; None if it has none."""
    while True:
        opcode, _, content = read_frame(file, size)
        if opcode == Opcode.STATISTICS:
            found: Statistics = Statistics.read(ReadDataStream(BytesIO(content)))
            return found
        if opcode == Opcode.FOOTER:
            return None
