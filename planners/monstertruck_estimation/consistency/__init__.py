"""Comparison of the robot's independent motion measures, to find the sensor that is wrong and its error."""
