"""Names of the forms in which camera intrinsics are written; light, for the command line."""

from enum import StrEnum


class LensForm(StrEnum):
    """Forms in which camera intrinsics are written."""

    CONFIG = "config"
    ROS = "ros"
    KALIBR = "kalibr"
    OPENCV = "opencv"
