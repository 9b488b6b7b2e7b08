"""Heavy work in separate processes, so that it never stalls the event loop."""
