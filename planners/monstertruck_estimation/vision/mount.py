"""Axes of a camera on a body; loads no library."""

import math

import numpy as np

from monstertruck_kinematics.elementary import Array


def rotation(yaw: float, pitch: float, roll: float) -> Array:
    """From a device's axes to those of its body, (3, 3): yaw, then pitch, then roll (REP 103), rad."""
    cy, sy, cp, sp, cr, sr = (f(v) for v in (yaw, pitch, roll) for f in (math.cos, math.sin))
    return np.array(
        (
            (cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr),
            (sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr),
            (-sp, cp * sr, cp * cr),
        )
    )


def camera_axes(yaw: float, pitch: float, roll: float) -> Array:
    """From a camera's axes (right, down, ahead) to those of its body, (3, 3), by the mount's angles, rad."""
    turned = rotation(yaw, pitch, roll)
    return np.stack((-turned[:, 1], -turned[:, 2], turned[:, 0]), axis=1)
