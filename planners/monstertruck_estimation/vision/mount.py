"""Axes of a camera on a body; imports no library."""

import numpy as np

from monstertruck_kinematics.elementary import Array, rotation


def camera_axes(yaw: float, pitch: float, roll: float) -> Array:
    """Return the rotation, (3, 3), from a camera's axes (right, down, ahead) to its body's, by its mount (rad)."""
    turned = rotation(yaw, pitch, roll)
    return np.stack((-turned[:, 1], -turned[:, 2], turned[:, 0]), axis=1)
