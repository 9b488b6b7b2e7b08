"""Measurement of the range finder."""

from typing import Annotated

from pydantic import Field

from monstertruck_schemas.base import Message


class SonarRange(Message):
    """Distance to the nearest object straight ahead of the device."""

    distance: Annotated[float, Field(gt=0)] | None
    """Distance (m); None if no object is within range."""
