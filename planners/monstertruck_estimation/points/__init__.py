"""Points of interest: tags that the camera reads, and places that an operator marks, as objects of the map."""
