"""Tuning of gains by runs of the robot."""
