"""Dynamixel AX-12A servos on one half-duplex bus: the two joints of the lidar stabiliser."""
