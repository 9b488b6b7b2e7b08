"""Calibration of a truck: guided wizards, and the dated file of their results."""
