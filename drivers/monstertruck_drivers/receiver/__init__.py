"""Radio-control receivers, for an operator next to the robot."""
