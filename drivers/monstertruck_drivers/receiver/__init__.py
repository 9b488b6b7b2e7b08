"""Receivers of radio controls: the operator beside the robot."""
