"""The robot without a robot: device emulators tied to a simulated world. Never imported by the daemon."""
