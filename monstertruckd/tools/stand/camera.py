"""Camera poses over a plane: from pixels to points of the stand, and back. The plane is z = 0, with z upwards."""

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np

from monstertruck_estimation.vision.lens import Lens
from monstertruck_kinematics.elementary import Array


@dataclass(frozen=True)
class PlacedCamera:
    """A camera with its pose in the stand."""

    lens: Lens
    rotation: Array
    """Rotation vector from the stand's to the camera's axes, (3,) (rad)."""
    translation: Array
    """The stand's origin in the camera frame, (3,) (m)."""

    @cached_property
    def axes(self) -> Array:
        """The camera's axes in the stand as rows, (3, 3)."""
        return rotation_matrix(self.rotation)

    @property
    def centre(self) -> Array:
        """Centre of the lens in the stand, (3,) (m)."""
        return -self.axes.T @ self.translation

    def on_plane(self, pixels: Array, height: float = 0.0) -> Array:
        """Return the points of a level plane seen at pixels (m); (n, 2) both.

        Args:
            pixels: image points.
            height: height of the plane above the stand's plane (m).
        """
        return meet(self.lens.directions(pixels), self.axes, self.translation, height)

    def project(self, points: Array) -> Array:
        """Return the pixels of points of the stand; from (n, 3) to (n, 2)."""
        shown, _ = cv2.projectPoints(
            np.ascontiguousarray(points, dtype=np.float64),
            self.rotation,
            self.translation,
            self.lens.matrix,
            self.lens.distortion,
        )
        return np.asarray(shown).reshape(-1, 2)

    def border(self, pixels: Array) -> float:
        """Return the minimum distance of pixels from the image border, as a fraction of its height."""
        width, height = self.lens.size
        x, y = pixels[:, 0], pixels[:, 1]
        return float(min(x.min(), y.min(), (width - 1 - x).min(), (height - 1 - y).min())) / height


def rotation_matrix(vector: Array) -> Array:
    """Return the rotation matrix (3, 3) of a rotation vector (3,), by Rodrigues' formula."""
    return np.asarray(cv2.Rodrigues(np.asarray(vector, dtype=np.float64))[0])


def meet(directions: Array, axes: Array, translation: Array, height: float = 0.0) -> Array:
    """Return the intersections of a camera's rays with a level plane (m), (n, 2).

    Args:
        directions: x and y at z = 1 of the camera, (n, 2).
        axes: axes of the camera in the stand, as rows, (3, 3).
        translation: the stand's origin in the camera's frame (m).
        height: height of the plane (m).
    """
    rays = np.column_stack((directions, np.ones(len(directions)))) @ axes
    centre = -axes.T @ translation
    way = (height - centre[2]) / rays[:, 2]
    return np.asarray(centre[:2] + way[:, None] * rays[:, :2])
