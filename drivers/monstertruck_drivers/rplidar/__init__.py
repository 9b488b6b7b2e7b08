"""SLAMTEC RPLIDAR laser scanners."""
