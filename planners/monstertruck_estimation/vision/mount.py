"""Axes of a camera on a body; loads no library."""

import numpy as np

from monstertruck_kinematics.elementary import Array, rotation


def camera_axes(yaw: float, pitch: float, roll: float) -> Array:
    """Rotation from a camera's axes (right, down, ahead) to its body's, (3, 3), by the mount's angles, rad."""
    turned = rotation(yaw, pitch, roll)
    return np.stack((-turned[:, 1], -turned[:, 2], turned[:, 0]), axis=1)
