"""Behaviours beside driving along a path: keeping the lidar level."""
