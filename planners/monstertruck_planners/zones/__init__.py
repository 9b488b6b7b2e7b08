"""Keepout and speed zones: loading, service, and conversion to ground for planners and gate."""
