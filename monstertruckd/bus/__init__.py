"""Message bus: message passing inside the process, and its bridge to Zenoh."""
