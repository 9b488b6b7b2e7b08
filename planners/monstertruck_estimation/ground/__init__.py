"""Tilt and roughness of the ground."""
