"""Poses and twists of the plane: the one home of their types."""

Pose2 = tuple[float, float, float]
"""x, y (m) and yaw (rad) in a frame."""
Twist2 = tuple[float, float, float]
"""vx, vy (m/s) and wz (rad/s) of a point, in the body frame."""
