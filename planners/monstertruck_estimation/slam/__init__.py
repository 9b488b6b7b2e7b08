"""Planar SLAM: scan preparation, scan-to-submap matching, loop closure, pose graph.

Only workers load this package, which needs numba and scipy; the daemon imports its ``service``, ``worker_io`` and
``config``, which need neither.
"""
