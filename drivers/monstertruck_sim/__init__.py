"""Simulated world with an emulated robot and computer."""
