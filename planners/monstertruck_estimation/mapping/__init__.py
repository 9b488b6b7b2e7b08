"""Occupancy maps of the SLAM: grid, storage, localisation in a saved map.

All but ``config`` and ``exchange`` load in workers only (numba).
"""
