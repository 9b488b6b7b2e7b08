"""Checks of a truck's computer before it drives: what works, what does not, and the command that fixes it."""
