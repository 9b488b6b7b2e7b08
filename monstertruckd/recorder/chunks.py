"""Bounded decompression of MCAP chunks; the size a chunk declares is not trusted."""

import zlib
from collections.abc import Iterator
from io import BytesIO
from typing import Final

import lz4.frame
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, McapRecord, Message, Schema

from monstertruck_runtime.outside import MOST_UNPACKED
from monstertruck_runtime.small_files import MEGABYTE

LIMIT: Final = f"expected at most {MOST_UNPACKED // MEGABYTE} MB"


def unpacked(chunk: Chunk) -> bytes:
    """Return the content of a chunk, decompressed and checked.

    Raises:
        McapError: the content exceeds ``MOST_UNPACKED``, differs from its declared size, or fails its checksum.
        RuntimeError: the lz4 data is damaged.
        zstandard.ZstdError: the zstd data is damaged.
    """
    size = chunk.uncompressed_size
    if size > MOST_UNPACKED:
        raise McapError(f"a chunk of {size / MEGABYTE:.0f} MB: {LIMIT}")
    match chunk.compression:
        case "":
            data = chunk.data
        case "zstd":
            bounded = zstandard.ZstdDecompressor(max_window_size=MOST_UNPACKED)
            with bounded.stream_reader(chunk.data) as stream:
                data = stream.read(size + 1)
        case "lz4":
            data = lz4.frame.LZ4FrameDecompressor().decompress(chunk.data, max_length=size + 1)
        case other:
            raise McapError(f"a chunk compressed by {other[:20]!r}: expected lz4, zstd or none")
    if len(data) != size:
        raise McapError(f"a chunk of {'more' if len(data) > size else 'less'} than the {size} bytes in its header")
    if chunk.uncompressed_crc not in (0, zlib.crc32(data)):
        raise McapError("checksum of a chunk")
    return data


def records_in(content: bytes) -> Iterator[McapRecord]:
    """Yield the schemas, channels and messages of a chunk in order.

    Raises:
        McapError: a record is longer than the chunk.
        mcap.exceptions.EndOfFile, ValueError: a record is damaged.
    """
    stream = ReadDataStream(BytesIO(content))
    while stream.count < len(content):
        opcode, length = stream.read1(), stream.read8()
        end = stream.count + length
        if end > len(content):
            raise McapError("a record longer than its chunk")
        match opcode:
            case Opcode.MESSAGE:
                yield Message.read(stream, length)
            case Opcode.CHANNEL:
                yield Channel.read(stream)
            case Opcode.SCHEMA:
                yield Schema.read(stream)
        if stream.count > end:
            raise McapError("a record longer than its stated length")
        stream.read(end - stream.count)
