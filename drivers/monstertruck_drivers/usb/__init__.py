"""USB devices identified by hub and port; a hub with its devices is lost and returns as one event."""
