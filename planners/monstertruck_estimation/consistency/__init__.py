"""Independent measures of the robot's motion, compared with each other: which sensor lies, and by how much."""
