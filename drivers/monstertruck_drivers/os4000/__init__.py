"""OceanServer OS4000 compass: heading, tilt, magnetic field and acceleration."""
