"""Receivers of radio controls, for the operator next to the robot."""
