"""Kinematics of the truck and of every wheeled-robot family: pure numpy, no I/O."""
