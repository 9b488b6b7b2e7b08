"""LDROBOT LD06, LD19 and STL-19P laser scanners."""
