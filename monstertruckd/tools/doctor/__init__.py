"""Looks a truck's computer over before it drives: what is fine, what is not, and the command that mends it."""
