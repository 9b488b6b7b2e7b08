"""Laser scanner described by its data sheet."""
