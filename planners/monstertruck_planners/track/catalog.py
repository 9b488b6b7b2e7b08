"""Path trackers by ``kind``."""

from typing import TYPE_CHECKING, Annotated, Any, Final, cast

from monstertruck_kinematics.truck import FourWheelSteering
from monstertruck_planners.track.config import TrackerConfig
from monstertruck_runtime.plugins import Catalog, Plugin

if TYPE_CHECKING:
    from monstertruck_planners.track.path_tracker import PathTracker

TRACKERS: Final = Catalog(
    "monstertruck.trackers",
    Plugin(
        name="pure_pursuit",
        settings="monstertruck_planners.track.config:PurePursuitConfig",
        implementation="monstertruck_planners.track.pure_pursuit:PurePursuit",
        doc="Arc through a point ahead on the path",
    ),
    Plugin(
        name="fuzzy",
        settings="monstertruck_planners.track.config:FuzzyConfig",
        implementation="monstertruck_planners.track.fuzzy:Fuzzy",
        doc="Fuzzy controller of rsband_local_planner",
    ),
    Plugin(
        name="lqr",
        settings="monstertruck_planners.track.config:LqrConfig",
        implementation="monstertruck_planners.track.lqr:Lqr",
        doc="Linear-quadratic regulator with preview of the path",
    ),
    Plugin(
        name="mpc",
        settings="monstertruck_planners.track.config:MpcConfig",
        implementation="monstertruck_planners.track.mpc:Mpc",
        doc="Model-predictive control with limits of angles and rates",
        extra="planning",
    ),
    base=TrackerConfig,
)
"""A tracker kind is built from its settings and the truck's geometry, and is a ``PathTracker``."""

AnyTracker = Annotated[TrackerConfig, TRACKERS.section()]
"""Section `tracker` of the configuration."""


def build_tracker(config: TrackerConfig, steering: FourWheelSteering) -> "PathTracker[Any]":
    """Build the tracker of a configuration.

    Args:
        config: settings with their ``kind``.
        steering: steering geometry of the truck.

    Raises:
        InputError: the kind does not exist, or a required package is not installed.
    """
    return cast("PathTracker[Any]", TRACKERS.build(config, config, steering))
