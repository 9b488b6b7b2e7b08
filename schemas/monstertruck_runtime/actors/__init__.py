"""Actors: heavy work in separate processes, so that it never blocks the event loop."""
