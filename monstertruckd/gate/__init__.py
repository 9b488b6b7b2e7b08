"""The safety gate: the only component that writes to the actuators."""
