"""Goals: from a requested pose to the truck at rest there, or to the reason why not."""
