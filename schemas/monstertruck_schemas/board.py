"""Printed patterns for cameras: the calibration board, and the colours of discs on robots."""

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from monstertruck_schemas.base import Schema

Colour = Literal["red", "yellow", "green", "blue", "magenta"]


TagFamily = Literal[
    "36h11", "25h9", "16h5", "aruco_original",
    "aruco_4x4_50", "aruco_4x4_100", "aruco_4x4_250", "aruco_4x4_1000",
    "aruco_5x5_50", "aruco_5x5_100", "aruco_5x5_250", "aruco_5x5_1000",
    "aruco_6x6_50", "aruco_6x6_100", "aruco_6x6_250", "aruco_6x6_1000",
    "aruco_7x7_50", "aruco_7x7_100", "aruco_7x7_250", "aruco_7x7_1000",
]  # fmt: skip
"""Tag families supported by OpenCV."""


class BoardConfig(Schema):
    """Printed ChArUco board with markers of family 36h11."""

    columns: Annotated[int, Field(ge=4, le=30)] = 8
    """Number of squares across"""
    rows: Annotated[int, Field(ge=4, le=30)] = 6
    """Number of squares down"""
    square: Annotated[float, Field(gt=0, le=1)] = 0.04
    """Side of a square as measured on the print, m"""
    marker: Annotated[float, Field(gt=0, le=1)] = 0.03
    """Side of a marker, m"""

    @model_validator(mode="after")
    def _markers_lie_in_squares(self) -> Self:
        if not self.marker < self.square:
            raise ValueError(f"marker {self.marker}: expected less than the square's {self.square}")
        return self

    @property
    def width(self) -> float:
        """Width of the board, m."""
        return self.columns * self.square

    @property
    def height(self) -> float:
        """Height of the board, m."""
        return self.rows * self.square
