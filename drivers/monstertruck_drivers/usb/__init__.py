"""USB devices identified by hub and port; the loss or return of a hub with its devices is one event."""
