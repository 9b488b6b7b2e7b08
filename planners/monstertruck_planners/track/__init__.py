"""Trackers: from a path and the present pose to speed and axle angles."""
