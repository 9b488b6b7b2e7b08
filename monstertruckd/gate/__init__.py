"""The safety gate: the only writer of actuators."""
