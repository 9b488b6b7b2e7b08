"""Planar SLAM: scan preparation, scan-to-submap matching, loop closure, pose graph.

Loaded in workers only, for numba and scipy; ``se2`` and ``config`` are plain numpy and light.
"""
