"""Calibration of a truck: guided wizards, and dated files with their results."""
