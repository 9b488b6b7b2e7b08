"""Exploration: where to look next in a map that grows; sends goals to the goal service and drives nothing itself."""
