"""Grid of the ground's tilt and roughness."""
