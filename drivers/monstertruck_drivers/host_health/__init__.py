"""Health of the computer the daemon runs on."""
