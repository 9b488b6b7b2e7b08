"""Framing of MCAP files: records, the index at the end, and checksums."""

import os
import struct
import zlib
from dataclasses import replace
from hashlib import blake2b
from io import BytesIO
from pathlib import Path
from typing import Any, BinaryIO, Final

import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import EndOfFile, McapError
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    Chunk,
    ChunkIndex,
    Header,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
)

from monstertruck_runtime.errors import InputError, NotFoundError
from monstertruck_runtime.outside import MOST_UNPACKED
from monstertruck_runtime.small_files import DAMAGED, MEGABYTE, require_file
from monstertruckd.recorder.chunks import LIMIT

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
"""Exceptions of the libraries on damaged bytes (lz4: RuntimeError; bad checksums: ValueError)."""

_END: Final = struct.Struct("<BQQQI8s")
"""Footer and magic: opcode, length, where the summary and its offsets begin, checksum."""

_FOOTER_LENGTH: Final = struct.calcsize("<QQI")
_UNSUMMED: Final = struct.calcsize("<I8s")
HEAD: Final = struct.Struct("<BQ")
"""Head of a record: opcode, length of the content."""
CHECKSUM: Final = struct.Struct("<I")

READERS: Final[dict[int, Any]] = {
    Opcode.HEADER: Header,
    Opcode.SCHEMA: Schema,
    Opcode.CHANNEL: Channel,
    Opcode.CHUNK: Chunk,
    Opcode.ATTACHMENT: Attachment,
    Opcode.METADATA: Metadata,
    Opcode.CHUNK_INDEX: ChunkIndex,
    Opcode.ATTACHMENT_INDEX: AttachmentIndex,
    Opcode.METADATA_INDEX: MetadataIndex,
    Opcode.STATISTICS: Statistics,
}
"""Record classes by opcode, except messages, whose reader needs their length."""

PRIVATE: Final = 0x80
"""First private opcode; unknown lower opcodes are damage."""


def is_finished(path: Path) -> bool:
    """Return whether the file has the ending of a finished log."""
    with path.open("rb") as file:
        size = file.seek(0, os.SEEK_END)
        file.seek(-min(size, len(MAGIC)), os.SEEK_END)
        return size > len(MAGIC) and file.read() == MAGIC


def index_is_sound(file: BinaryIO) -> bool:
    """Return whether a log is finished and its index, if it has one, matches the checksum.

    Args:
        file: the log; its position changes.
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
    """CRC-32 of the bytes from ``begin`` to before ``end``, read in pieces."""
    file.seek(begin)
    value = 0
    piece = 1 << 20
    for at in range(begin, end, piece):
        value = zlib.crc32(file.read(min(piece, end - at)), value)
    return value


def read_frame(file: BinaryIO, size: int) -> tuple[int, bytes, bytes]:
    """Return opcode, head and content of the next record of a file of ``size`` bytes.

    Raises:
        EndOfFile: the record is cut off.
        McapError: the record is longer than ``MOST_UNPACKED``.
    """
    head = file.read(HEAD.size)
    if len(head) < HEAD.size:
        raise EndOfFile
    opcode, length = HEAD.unpack(head)
    if length > size - file.tell():
        raise EndOfFile
    if length > MOST_UNPACKED:
        raise McapError(f"a record of {length / MEGABYTE:.0f} MB: {LIMIT}")
    return opcode, head, file.read(length)


def read_statistics(file: BinaryIO, size: int) -> Statistics | None:
    """Return the statistics in the undamaged index at the position of ``file``, or None."""
    while True:
        opcode, _, content = read_frame(file, size)
        if opcode == Opcode.STATISTICS:
            found: Statistics = Statistics.read(ReadDataStream(BytesIO(content)))
            return found
        if opcode == Opcode.FOOTER:
            return None


def digest_of(opcode: int, content: bytes) -> bytes:
    """Return a digest for recognising repeated records."""
    # 16: bytes of a chunk's two times
    begin = 16 if opcode == Opcode.CHUNK else 0  # the times of a chunk have no checksum
    return blake2b(content[begin:], digest_size=16).digest()


def checked_attachment(record: Attachment, content: bytes) -> Attachment:
    """Return an attachment, renamed if its checksum, which mcap does not verify, is wrong.

    Args:
        record: the attachment.
        content: content of its record in the file.
    """
    (expected,) = CHECKSUM.unpack(content[-CHECKSUM.size :])
    if expected in (0, zlib.crc32(content[: -CHECKSUM.size])):
        return record
    return replace(record, name=record.name + DAMAGED, media_type="application/octet-stream")


def open_file(path: Path) -> BinaryIO:
    """Open a log for reading without checking its content.

    Raises:
        NotFoundError: the file does not exist.
        InputError: the path is a folder, or the file cannot be read.
    """
    try:
        require_file(path)
        return path.open("rb")
    except FileNotFoundError:
        raise NotFoundError(f"{path}: no such log") from None
    except IsADirectoryError:
        raise InputError(f"{path}: a folder; `monstertruckd log list {path}` lists the logs in it") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from None
