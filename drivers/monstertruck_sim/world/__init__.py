"""The simulated world behind the emulators: a 2D map, the truck's physics and the inputs of its sensors."""
