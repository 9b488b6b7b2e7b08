"""Health of the computer that runs the daemon."""
