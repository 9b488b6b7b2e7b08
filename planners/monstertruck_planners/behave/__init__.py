"""Behaviours: motion in reaction to sensors, without a path; and keeping the lidar level."""
