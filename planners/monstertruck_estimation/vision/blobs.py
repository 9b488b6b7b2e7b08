"""Detection of coloured discs in an image: connected pixels of one hue, and their centre.

Method of SwisTrack (Lochmatter et al., "SwisTrack", IROS 2008).
"""

from collections.abc import Collection
from typing import Final, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from monstertruck_kinematics.elementary import Array
from monstertruck_schemas.board import Colour

ColourPicture = NDArray[np.uint8]
"""Blue, green and red, shape (height, width, 3)."""

HUES: Final[dict[Colour, tuple[int, int]]] = {
    "red": (166, 12),
    "yellow": (18, 42),
    "green": (46, 80),
    "blue": (96, 132),
    "magenta": (138, 162),
}
"""First and last hue of each colour, in OpenCV's half degrees; red passes 180."""


class Blob(NamedTuple):
    """A disc in an image."""

    colour: Colour
    middle: Array
    """Centre, shape (2,) (pixels)."""
    pixels: int


class BlobReader:
    """Detects the discs in one camera's images.

    Args:
        colours: colours to detect.
    """

    def __init__(self, colours: Collection[Colour]) -> None:
        self._colours = sorted(colours)

    def read(self, picture: ColourPicture) -> list[Blob]:
        """Return the discs of an image; those cut by its border are left out."""
        hsv = cv2.cvtColor(picture, cv2.COLOR_BGR2HSV)
        height, width = picture.shape[:2]
        found: list[Blob] = []
        for colour in self._colours:
            count, _, boxes, middles = cv2.connectedComponentsWithStats(_of_hue(hsv, *HUES[colour]))
            for k in range(1, count):
                x, y, wide, high, pixels = (int(v) for v in boxes[k])
                # 12: minimum area of a disc in pixels 0.02: maximum area of a disc, as a fraction of the image 1.8:
                # maximum ratio of the sides of a disc's bounding box
                if not 12 <= pixels <= 0.02 * width * height or max(wide, high) > 1.8 * min(wide, high):
                    continue
                if x > 0 and y > 0 and x + wide < width and y + high < height:
                    found.append(Blob(colour, np.asarray(middles[k], dtype=np.float64), pixels))
        return found


def _of_hue(hsv: ColourPicture, first: int, last: int) -> NDArray[np.uint8]:
    def between(low: int, high: int) -> NDArray[np.uint8]:
        # 90: minimum saturation, of 255: tables and floors have less 30: minimum brightness, of 255: in the dark every
        # hue is noise
        return np.asarray(cv2.inRange(hsv, np.array((low, 90, 30)), np.array((high, 255, 255))), dtype=np.uint8)

    return between(first, last) if first <= last else between(first, 179) | between(0, last)
