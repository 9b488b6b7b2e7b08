"""What is printed for cameras: the board by which they are calibrated, and colours of discs that robots carry."""

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from monstertruck_schemas.base import Schema

Colour = Literal["red", "yellow", "green", "blue", "magenta"]


class BoardConfig(Schema):
    """Printed ChArUco board, its markers of family 36h11."""

    columns: Annotated[int, Field(ge=4, le=30)] = 8
    """Squares"""
    rows: Annotated[int, Field(ge=4, le=30)] = 6
    """Squares"""
    square: Annotated[float, Field(gt=0, le=1)] = 0.04
    """m, as measured on the print"""
    marker: Annotated[float, Field(gt=0, le=1)] = 0.03
    """m"""

    @model_validator(mode="after")
    def _markers_lie_in_squares(self) -> Self:
        if not self.marker < self.square:
            raise ValueError(f"marker {self.marker}: expected less than the square's {self.square}")
        return self

    @property
    def width(self) -> float:
        """M."""
        return self.columns * self.square

    @property
    def height(self) -> float:
        """M."""
        return self.rows * self.square
