"""State estimation: odometry, transforms, scan matching, maps."""
