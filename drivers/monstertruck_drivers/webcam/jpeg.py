"""Is this a whole JPEG, and can every viewer read it?

Source: ITU-T T.81, annex B (markers) and annex K.3 (Huffman tables, which motion-JPEG cameras may leave out).
"""

from typing import Final

START: Final = b"\xff\xd8"
END: Final = b"\xff\xd9"
_HUFFMAN: Final = 0xC4
_SCAN: Final = 0xDA
_FRAME_HEADERS: Final = frozenset(range(0xC0, 0xD0)) - {_HUFFMAN, 0xC8, 0xCC}

_TABLES: Final = bytes.fromhex(
    "0000010501010101010100000000000000000102030405060708090a0b100002010303020403050504040000017d01020300041105"
    "122131410613516107227114328191a1082342b1c11552d1f02433627282090a161718191a25262728292a3435363738393a434445"
    "464748494a535455565758595a636465666768696a737475767778797a838485868788898a92939495969798999aa2a3a4a5a6a7a8"
    "a9aab2b3b4b5b6b7b8b9bac2c3c4c5c6c7c8c9cad2d3d4d5d6d7d8d9dae1e2e3e4e5e6e7e8e9eaf1f2f3f4f5f6f7f8f9fa01000301"
    "01010101010101010000000000000102030405060708090a0b11000201020404030407050404000102770001020311040521310612"
    "41510761711322328108144291a1b1c109233352f0156272d10a162434e125f11718191a262728292a35363738393a434445464748"
    "494a535455565758595a636465666768696a737475767778797a82838485868788898a92939495969798999aa2a3a4a5a6a7a8a9aa"
    "b2b3b4b5b6b7b8b9bac2c3c4c5c6c7c8c9cad2d3d4d5d6d7d8d9dae2e3e4e5e6e7e8e9eaf2f3f4f5f6f7f8f9fa"
)
TABLES_SEGMENT: Final = b"\xff\xc4" + (2 + len(_TABLES)).to_bytes(2, "big") + _TABLES


def complete(data: bytes) -> bytes:
    """The picture from its FF D8 to its FF D9, with Huffman tables.

    Headers are followed; the compressed part is not decoded, so that a flipped bit in it shows in the picture only.

    Args:
        data: what the camera sent; zeros behind the picture are cut off.

    Raises:
        ValueError: cut off, or no JPEG; the text says where it ends to be one.
    """
    end = data.rfind(END) + len(END)
    if end < len(END) or data[end:].strip(b"\0"):
        raise ValueError(f"{len(data)} bytes do not end in FF D9")
    scan, has_tables = _follow(data)
    if has_tables:
        return data[:end]
    return data[:scan] + TABLES_SEGMENT + data[scan:end]


def _follow(data: bytes) -> tuple[int, bool]:
    """Where the scan begins, and whether Huffman tables come before it."""
    if not data.startswith(START):
        raise ValueError(f"begins with {data[:2].hex(' ')} instead of FF D8")
    at, has_tables, has_frame = len(START), False, False
    while at + 4 <= len(data) and data[at] == 0xFF:
        marker = data[at + 1]
        if marker == _SCAN and has_frame:
            return at, has_tables
        has_tables |= marker == _HUFFMAN
        has_frame |= marker in _FRAME_HEADERS
        at += 2 + int.from_bytes(data[at + 2 : at + 4], "big")
    raise ValueError(f"header breaks off at byte {at}")
