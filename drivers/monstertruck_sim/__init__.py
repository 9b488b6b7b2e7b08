"""The far side of the cables: a simulated world, and an emulated robot and computer in it."""
