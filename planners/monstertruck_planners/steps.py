"""The planners' steps that may be taken elsewhere, in a worker or on another machine, and what travels there."""

from typing import Final

from monstertruck_kinematics.truck import FourWheelSteering
from monstertruck_planners.collision import Footprint
from monstertruck_planners.goals.config import EscapeConfig, LocalConfig, PlannerConfig
from monstertruck_planners.goals.exchange import DeformAnswer, DeformTask, PlanAnswer, PlanTask, Setup, Way
from monstertruck_planners.local.config import BandConfig, PublishedConfig, RsbandConfig, TebConfig
from monstertruck_planners.route.config import HybridConfig, LatticeConfig
from monstertruck_planners.track.api import Command
from monstertruck_planners.track.config import FuzzyConfig, LqrConfig, MpcConfig, PurePursuitConfig, StanleyConfig
from monstertruck_planners.track.line import Progress
from monstertruck_planners.track.step import StepEvent, TrackInput, TrackOutput, TrackSetup
from monstertruck_runtime.actors.codec import StepCodec
from monstertruck_schemas.base import Pose2D, Twist2D
from monstertruck_schemas.event import Severity
from monstertruck_schemas.plan import Path
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import Role
from monstertruck_schemas.sensor import Attitude, LaserScan, Vector3
from monstertruck_schemas.state import GateMode, GateState, Grid, Odometry

PLANNING: Final = "planning"
DEFORMING: Final = "deforming"
TRACKING: Final = "tracking"

STEPS: Final = {
    PLANNING: "monstertruck_planners.goals.planning_worker:PlanningWorker",
    DEFORMING: "monstertruck_planners.goals.deforming_worker:DeformingWorker",
    TRACKING: "monstertruck_planners.track.step:TrackingWorker",
}
"""``module:factory`` by name."""

CODEC: Final = StepCodec(
    (
        *(PlanTask, PlanAnswer, Setup, PlannerConfig, EscapeConfig, HybridConfig, LatticeConfig, Grid, Pose2D),
        *(DeformTask, DeformAnswer, Way, LocalConfig, RsbandConfig, PublishedConfig, TebConfig, BandConfig),
        *(TrackInput, TrackOutput, TrackSetup, StepEvent, Command, Progress, Odometry, Twist2D, Path, GateState),
        *(LaserScan, Attitude, Vector3, FuzzyConfig, LqrConfig, MpcConfig, PurePursuitConfig, StanleyConfig),
        *(FourWheelSteering, Footprint, Reason, Severity, Role, GateMode),
    )
)
"""Of inputs and outputs of all steps."""
