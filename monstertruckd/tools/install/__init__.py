"""The daemon as a system service: systemd unit and udev rules, installation and removal."""
