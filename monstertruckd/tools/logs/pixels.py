"""Decoding of recorded pictures to arrays."""

from io import BytesIO
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from monstertruck_runtime.outside import reading, require_pixels


def pixels_of(data: bytes, where: str) -> NDArray[np.uint8]:
    """Decode a JPEG to RGB, shape (height, width, 3).

    Args:
        data: the file.
        where: origin of the picture, for error messages.

    Raises:
        InputError: the picture is damaged or has too many pixels.
    """
    with reading(Path(where), "a picture"), Image.open(BytesIO(data), formats=["JPEG"]) as image:
        require_pixels(where, image.width, image.height)
        return np.asarray(image.convert("RGB"))
