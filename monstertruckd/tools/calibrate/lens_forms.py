"""Names of the file formats for camera intrinsics, without heavy imports, for the command line."""

from enum import StrEnum


class LensForm(StrEnum):
    """File formats for camera intrinsics."""

    CONFIG = "config"
    ROS = "ros"
    KALIBR = "kalibr"
    OPENCV = "opencv"
