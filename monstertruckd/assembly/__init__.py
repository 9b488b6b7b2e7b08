"""Builds what a configuration describes and connects it to the bus."""
