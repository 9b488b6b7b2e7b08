"""Planners' steps that can run in a worker or on another machine, and the messages exchanged with them."""

from typing import Final

from monstertruck_planners.explore.exchange import ExploreAnswer, ExploreTask
from monstertruck_planners.goals.exchange import DeformAnswer, DeformTask, PlanTask, RouteAnswer
from monstertruck_planners.track.service import TrackInput, TrackOutput
from monstertruck_runtime.actors.remote import StepCodec
from monstertruck_schemas.plan import Path
from monstertruck_schemas.sensor import Attitude, LaserScan
from monstertruck_schemas.state import GateState, Odometry

PLANNING: Final = "planning"
DEFORMING: Final = "deforming"
TRACKING: Final = "tracking"
EXPLORING: Final = "exploring"

STEPS: Final = {
    PLANNING: "monstertruck_planners.goals.plan_step:PlanningWorker",
    DEFORMING: "monstertruck_planners.goals.deform_step:DeformingWorker",
    TRACKING: "monstertruck_planners.track.service:TrackingWorker",
    EXPLORING: "monstertruck_planners.explore.explore_step:ExploringWorker",
}
"""``module:factory`` by name."""

PLANNING_BY_KIND: Final = {"hybrid": "monstertruck_planners.goals.plan_step:hybrid_worker"}
"""Planning steps that compile only the code of one kind of route planner, by kind."""

CODEC: Final = StepCodec(
    *(PlanTask, RouteAnswer, DeformTask, DeformAnswer, TrackInput, TrackOutput, ExploreTask, ExploreAnswer),
    # What ``TrackInput.news`` holds.
    *(Odometry, Path, GateState, LaserScan, Attitude),
)
"""Codec of inputs and outputs of all steps, and of all plug-in settings that they may contain."""
