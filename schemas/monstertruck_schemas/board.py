"""The printed board by which cameras are calibrated."""

from typing import Annotated

from pydantic import Field

from monstertruck_schemas.base import Schema


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

    @property
    def width(self) -> float:
        """M."""
        return self.columns * self.square

    @property
    def height(self) -> float:
        """M."""
        return self.rows * self.square
