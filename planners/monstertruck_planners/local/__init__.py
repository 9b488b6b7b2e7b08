"""Deformation of a route in the truck's surroundings: elastic bands and what makes them drivable."""
