"""Driving by hand: the keys of a terminal or a gamepad as a deadman switch."""
