"""Settings of the tracker."""

from typing import Annotated, Literal

from pydantic import Field

from monstertruck_planners.track.config import TrackerConfig


class LinearConfig(TrackerConfig):
    """Lateral error falls off within some multiples of a length, whatever the speed."""

    kind: Literal["linear"]
    length: Annotated[float, Field(gt=0)] = 0.3
    """Distance in which an error falls to about a third, m."""
    damping: Annotated[float, Field(gt=0)] = 1.0
    """1: as fast as it goes without overshoot."""
