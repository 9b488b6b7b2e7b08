"""Pictures for tests."""

import io
from functools import cache

import numpy as np
from PIL import Image


@cache
def picture(size: tuple[int, int] = (64, 48), seed: int = 0) -> bytes:
    """A small JPEG of noise."""
    pixels = np.random.default_rng(seed).integers(0, 255, (size[1], size[0], 3), dtype=np.uint8)
    out = io.BytesIO()
    Image.fromarray(pixels).save(out, "JPEG")
    return out.getvalue()


def bare(data: bytes) -> bytes:
    """Without its Huffman tables, as cameras send it."""
    head, _, tail = data.partition(b"\xff\xc4")
    return head + tail[tail.index(b"\xff\xda") :]


def pixels(data: bytes) -> np.ndarray:
    return np.asarray(Image.open(io.BytesIO(data)))
