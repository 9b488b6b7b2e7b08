"""Places of cameras over a plane: from pixels to points of the stand, and back. Its plane is z = 0, z upwards."""

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np

from monstertruck_estimation.vision.lens import Lens
from monstertruck_kinematics.elementary import Array


@dataclass(frozen=True)
class PlacedCamera:
    """A camera over the stand."""

    lens: Lens
    rotation: Array
    """(3,): rotation vector from the stand's to the camera's axes (rad)."""
    translation: Array
    """(3,): the stand's origin as the camera has it (m)."""

    @cached_property
    def axes(self) -> Array:
        """(3, 3): the camera's axes in the stand, as rows."""
        return rotation_matrix(self.rotation)

    @property
    def centre(self) -> Array:
        """(3,): of the lens in the stand (m)."""
        return -self.axes.T @ self.translation

    def on_plane(self, pixels: Array, height: float = 0.0) -> Array:
        """Points of a level plane that pixels show (m); (n, 2) both.

        Args:
            pixels: seen.
            height: height of the plane above the stand's plane (m).
        """
        return meet(self.lens.directions(pixels), self.axes, self.translation, height)

    def project(self, points: Array) -> Array:
        """Pixels of points of the stand; from (n, 3) to (n, 2)."""
        shown, _ = cv2.projectPoints(
            np.ascontiguousarray(points, dtype=np.float64),
            self.rotation,
            self.translation,
            self.lens.matrix,
            self.lens.distortion,
        )
        return np.asarray(shown).reshape(-1, 2)

    def border(self, pixels: Array) -> float:
        """Minimum distance of pixels from the picture's border, as a fraction of its height."""
        width, height = self.lens.size
        x, y = pixels[:, 0], pixels[:, 1]
        return float(min(x.min(), y.min(), (width - 1 - x).min(), (height - 1 - y).min())) / height


def rotation_matrix(vector: Array) -> Array:
    """Rodrigues' formula; from (3,) to (3, 3)."""
    return np.asarray(cv2.Rodrigues(np.asarray(vector, dtype=np.float64))[0])


def meet(directions: Array, axes: Array, translation: Array, height: float = 0.0) -> Array:
    """Intersections of a camera's rays with a level plane (m); (n, 2).

    Args:
        directions: x and y at z = 1 of the camera, (n, 2).
        axes: axes of the camera in the stand, as rows, (3, 3).
        translation: the stand's origin as the camera has it (m).
        height: height of the plane (m).
    """
    rays = np.column_stack((directions, np.ones(len(directions)))) @ axes
    centre = -axes.T @ translation
    way = (height - centre[2]) / rays[:, 2]
    return np.asarray(centre[:2] + way[:, None] * rays[:, :2])
