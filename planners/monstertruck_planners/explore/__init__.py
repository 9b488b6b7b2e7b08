"""Exploration: chooses the next viewpoint in a growing map and sends it as a goal to the goal service."""
