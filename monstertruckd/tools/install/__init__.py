"""The daemon as a service of the computer: what systemd and udev are given, and how it gets there and away again."""
