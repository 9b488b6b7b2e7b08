"""Trackers: compute speed and axle angles from a path and the current pose."""
