"""What the kinematics library raises."""


class KinematicsError(ValueError):
    """An argument, wheel or parameter that no robot can have; the text names it, its value and what was expected."""
