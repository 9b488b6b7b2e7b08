"""Heavy work in processes of its own, so that it never stalls the event loop."""
