"""Settings of the body."""

from typing import Annotated, Literal

from pydantic import Field

from monstertruck_schemas.body import BodyConfig


class TrackedBody(BodyConfig):
    """Two tracks (left, right) driven side by side; nothing is steered."""

    kind: Literal["tracked"]
    steering_ratio: Annotated[float, Field(ge=1, le=4)] = 1.5
    """Distance between the tracks' ICRs over that between the tracks; 1 = they do not skid"""
