"""Trackers: from a path and the current pose to speed and axle angles."""
