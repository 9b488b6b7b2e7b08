"""Planar SLAM: scan preparation, scan-to-submap matching, loop closure, pose graph.

Loaded in workers only, for numba and scipy; the daemon imports ``service``, ``worker_io`` and
``config``, which need neither.
"""
