"""What the computer and its init system see of the daemon: health, logging, notifications, stalls."""
