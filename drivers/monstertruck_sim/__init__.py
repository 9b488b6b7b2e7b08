"""Simulated world, with an emulated robot and computer in it, behind the cables."""
