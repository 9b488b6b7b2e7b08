"""Points of interest on the map: tags read by the camera and places marked by an operator."""
