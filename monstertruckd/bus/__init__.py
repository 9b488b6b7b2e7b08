"""Message bus: hand-over inside the process, and its bridge to Zenoh."""
