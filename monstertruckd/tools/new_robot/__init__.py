"""A new robot's configuration and its simulated twin, from a few answers."""
