"""Interface of the daemon to the computer and its init system: health, logging, notifications, stalls."""
