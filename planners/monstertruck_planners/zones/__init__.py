"""Keepout and speed zones: read, served, and turned into ground for planners and gate."""
