"""Planar SLAM: scan preparation, scan-to-submap matching, loop closure, pose graph. Loaded in workers only (numba, scipy)."""
