"""Settings of docks and docking; light, for the daemon's start.

Terms as in Nav2's docking server: staging pose, dock direction, undock.
"""

from typing import Annotated, Literal

from pydantic import Field

from monstertruck_planners.behave.api import BehaviourConfig
from monstertruck_schemas.base import Name, Schema

Metres = Annotated[float, Field(gt=0, le=5)]


class ChargingConfig(Schema):
    """Signs that the dock charges the battery."""

    current: Annotated[float, Field(gt=0, le=100)] = 0.3
    """Minimum current into the pack (A), of a robot that measures it"""
    voltage: Annotated[float, Field(gt=0, le=5)] = 0.15
    """Minimum rise of the voltage at rest since the arrival (V), of a robot that does not measure the current"""
    within: Annotated[float, Field(gt=0, le=300)] = 30.0
    """Maximum time from the arrival to the start of charging (s)"""


class HousingConfig(Schema):
    """Part of a dock that the lidar sees: a box beyond the end of the docked robot that touches it."""

    width: Annotated[float, Field(gt=0, le=2)]
    """Width across the approach, centred (m)"""
    depth: Annotated[float, Field(gt=0, le=1)]
    """Depth from the contacts away from the robot (m)"""


class DockConfig(Schema):
    """One dock: where the docked robot stands in the map, and the tag that marks the dock."""

    x: float
    """Docked robot (base) in map (m)"""
    y: float
    """In m"""
    yaw: float
    """Heading of the docked robot (rad)"""
    direction: Literal["forward", "reverse"] = "forward"
    """End of the robot that faces the dock"""
    tag: Annotated[int, Field(ge=0, le=1023)]
    """Number of the tag, of the family `points.family`; its side is in `points.sizes`"""
    tag_distance: Metres = 0.5
    """Distance from base of the docked robot to the tag, along the approach (m)"""
    tag_offset: Annotated[float, Field(ge=-1, le=1)] = 0.0
    """Offset of the tag to the left of the approach, seen towards the dock (m)"""
    staging: Annotated[float, Field(gt=0, le=1.5)] = 0.7
    """Distance of the staging pose before the docked pose (m)"""
    turning: Annotated[float, Field(gt=0, le=1.5)] = 1.0
    """Distance beyond the staging pose that a robot needs to turn its rear to the dock (m); `reverse` only"""
    housing: HousingConfig | None = None
    """Box that the gate lets the robot come near while it docks; null: the lidar sees nothing where the robot docks"""
    charging: ChargingConfig | None = ChargingConfig()
    """Signs of charging; null: docked is done"""


Docks = dict[Name, DockConfig]


class DockingConfig(BehaviourConfig):
    """Drive to a dock from its staging pose, and confirm that it charges."""

    kind: Literal["dock"] = "dock"
    rate: Annotated[float, Field(gt=0, le=50)] = 20.0
    """Steps per second"""
    docks: Docks = Field(default_factory=dict)
    """Docks by name: of the section `docks`"""
    dock: str = ""
    """Dock of this run; empty if there is one only"""
    speed: Annotated[float, Field(gt=0, le=0.5)] = 0.08
    """Maximum speed of the approach (m/s); the gate limits it further near the dock"""
    tolerance: Annotated[float, Field(gt=0, le=0.1)] = 0.01
    """Maximum distance from the docked pose (m)"""
    turn_tolerance: Annotated[float, Field(gt=0, le=0.2)] = 0.0175
    """Maximum difference in heading from the docked pose (rad)"""
    attempts: Annotated[int, Field(ge=1, le=20)] = 3
    """Attempts before docking has failed"""
    look: Annotated[float, Field(gt=0, le=30)] = 6.0
    """Maximum time until the tag is seen (s)"""


class UndockConfig(BehaviourConfig):
    """Drive from a dock back to its staging pose, in a straight line."""

    kind: Literal["undock"] = "undock"
    rate: Annotated[float, Field(gt=0, le=50)] = 20.0
    """Steps per second"""
    docks: Docks = Field(default_factory=dict)
    """Docks by name: of the section `docks`"""
    dock: str = ""
    """Dock that the robot leaves; empty if there is one only"""
    speed: Annotated[float, Field(gt=0, le=0.5)] = 0.08
    """Maximum speed (m/s)"""


def chosen(docks: Docks, name: str) -> tuple[str, DockConfig]:
    """Return the dock of a run, with its name.

    Raises:
        ValueError: no such dock, or several docks and no name.
    """
    if not docks:
        raise ValueError("the robot's configuration has no section `docks`")
    if not name and len(docks) > 1:
        raise ValueError(f"dock: expected one of {', '.join(docks)}")
    if name and name not in docks:
        raise ValueError(f"dock {name!r}: expected one of {', '.join(docks)}")
    name = name or next(iter(docks))
    return name, docks[name]
