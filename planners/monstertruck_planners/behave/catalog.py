"""Catalogs of behaviours, which react to sensors without a path, and of levelling, which keeps the lidar level."""

from typing import Annotated, Final

from monstertruck_planners.behave.api import BehaviourConfig
from monstertruck_runtime.plugins import Catalog, Plugin
from monstertruck_schemas.base import Schema

BEHAVIOURS: Final = Catalog(
    "monstertruck.behaviours",
    Plugin(
        name="wall_pd",
        settings="monstertruck_planners.behave.wall.config:WallPdConfig",
        implementation="monstertruck_planners.behave.wall.published:WallPd",
        doc="Follows a wall by PD control of its distance (coursework, method 1)",
    ),
    Plugin(
        name="wall_switching",
        settings="monstertruck_planners.behave.wall.config:WallSwitchingConfig",
        implementation="monstertruck_planners.behave.wall.published:WallSwitching",
        doc="Follows a wall by turning away and back (coursework, method 2)",
    ),
    Plugin(
        name="move",
        settings="monstertruck_planners.behave.move:MoveConfig",
        implementation="monstertruck_planners.behave.move:Move",
        doc="Drives one arc, straight or turn on the spot under a motion profile",
    ),
    Plugin(
        name="wall_line",
        settings="monstertruck_planners.behave.wall.config:WallLineConfig",
        implementation="monstertruck_planners.behave.wall.line:WallLine",
        doc="Follows a wall along a line fitted to the echoes (method 3, our own)",
    ),
    Plugin(
        name="follow",
        settings="monstertruck_planners.behave.follow:FollowConfig",
        implementation="monstertruck_planners.behave.follow:LeaderFollower",
        doc="Follows the path of another robot at a distance",
    ),
    Plugin(
        name="dock",
        settings="monstertruck_planners.behave.dock.config:DockingConfig",
        implementation="monstertruck_planners.behave.dock.docking:Dock",
        doc="Drives to a dock by its tag, and confirms that it charges",
    ),
    Plugin(
        name="undock",
        settings="monstertruck_planners.behave.dock.config:UndockConfig",
        implementation="monstertruck_planners.behave.dock.docking:Undock",
        doc="Drives from a dock back to its staging pose",
    ),
    base=BehaviourConfig,
)
"""Catalog of behaviours. A behaviour is a ``Behaviour`` made from its settings; it requests motion from the gate."""

AnyBehaviour = Annotated[BehaviourConfig, BEHAVIOURS.section()]
"""One of the configuration's section `behaviours`."""

LEVELLING: Final = Catalog(
    "monstertruck.levelling",
    Plugin(
        name="stabiliser",
        settings="monstertruck_planners.behave.stabiliser:StabiliserConfig",
        implementation="monstertruck_planners.behave.stabiliser:build_stabiliser",
        doc="Keeps the lidar level by the compass",
    ),
)
"""Catalog of levelling kinds: functions that build a ``Service`` from settings, clock and bus (a ``BusPort``)."""

AnyLevelling = Annotated[Schema, LEVELLING.section("stabiliser")]
"""The configuration's section `levelling`."""
