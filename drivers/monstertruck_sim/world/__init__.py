"""The simulated world behind the emulators: a 2D map, the truck's physics and its sensor inputs."""
