"""What is not the daemon: command line, calibration, logs, drills, doctor, installation, demo."""
