"""Behaviours other than driving along a path: keeping the lidar level."""
