"""Local planners: elastic bands around the obstacles on a route, and paths that make them drivable."""
