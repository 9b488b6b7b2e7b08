"""Inputs and outputs of the scan odometry's worker; without numba, so that the daemon can import them."""

from dataclasses import dataclass
from typing import Final

from monstertruck_estimation.consistency.config import ConsistencyConfig
from monstertruck_estimation.consistency.delay import SIGMAS, Delay, LagQuestion
from monstertruck_estimation.slam.worker_io import ScanInput
from monstertruck_kinematics.se2 import Pose2
from monstertruck_runtime.clock import SECOND
from monstertruck_schemas.state import StandingBody

IN_USE: Final = 2 * SECOND
"""Maximum age of a sample of a measure in use (ns); a lidar that was silent for longer may have another scale."""


@dataclass(frozen=True, slots=True)
class Claim:
    """Motion that another measure claims; the scans at both of its ends confirm or refute it."""

    since: int
    """Stamp of the earlier scan (ns)."""
    way: tuple[float, float] | None
    """Pose of base at the latest scan relative to the earlier one (m, rad); None to use the scans' own."""
    turn: float
    """Turn (rad)."""
    errors: tuple[float, float]
    """Maximum error of the claim if the measure works (m, rad)."""


@dataclass(frozen=True, slots=True)
class StepInput:
    """Input of one scan."""

    scan: ScanInput
    front: str
    """Scan odometry, see ``ConsistencyConfig.scans``."""
    anew: bool = False
    """Forget the earlier scans."""
    claim: Claim | None = None
    lag: LagQuestion | None = None
    rest: Claim | None = None
    """Claim that the body moves no more than its wheels."""
    rolled: Pose2 | None = None
    """Motion by the wheels since the previous scan; None if unknown."""
    slip: float = ConsistencyConfig().slip
    delay: float = ConsistencyConfig().delay
    drift: float = ConsistencyConfig().drift
    """See ``ConsistencyConfig``."""


REFUTING: Final = 12
"""Minimum number of points that fit only the scans' own motion to refute a claim."""


@dataclass(frozen=True, slots=True)
class ScanVerdict:
    """Fit of a claimed motion and of the scans' own to the latest scan: points that fit only one of them.

    Both motions are refined, the claimed one within its errors: the question is whether any motion near it fits.
    """

    claimed: int
    own: int
    misfits: int
    """Points that do not fit the scans' own motion."""

    @property
    def refuted(self) -> bool:
        """Whether the scans contradict the claim.

        Without constraints on the motion (a corridor, an open field), every point fits both motions. Among walking
        people some points fit either motion, and many fit neither.
        """
        outweighed = 4  # required points for the scans' own motion per point that fits only the claim
        return self.own >= max(REFUTING + outweighed * self.claimed, self.misfits)


@dataclass(frozen=True, slots=True)
class RestEvidence:
    """Evidence of a body motion that the wheels do not show."""

    motion: Pose2 = (0.0, 0.0, 0.0)
    """Pose of base at the latest scan, relative to the claimed pose (m, rad)."""
    sigmas: float = 0.0
    """Significance against standstill, in standard deviations of a normal distribution."""

    @property
    def proven(self) -> bool:
        """Whether the motion is significant."""
        return self.sigmas >= SIGMAS


@dataclass(frozen=True, slots=True)
class StepOutput:
    """Result of one scan."""

    stamp: int
    """Stamp of the scan (ns)."""
    since: int | None
    """Stamp of the previous scan; None after a gap: the motion since then is unknown."""
    motion: Pose2 = (0.0, 0.0, 0.0)
    """Base at ``stamp`` in base at ``since``."""
    deviations: tuple[float, float] = (1.0, 1.0)
    """Standard deviations of the place ahead (m) and of the yaw (rad) at ``stamp``, against a scan several steps old.

    The error of one step recurs in the next with the opposite sign.
    """
    scatter: tuple[float, float] = (0.0, 0.0)
    """The same deviations from the scatter of the latest motions: no robot moves to and fro from scan to scan."""
    overlap: float = 0.0
    """Share of the points that fit the previous scan."""
    verdict: ScanVerdict | None = None
    """Verdict on the claim; None without a claim, or if the earlier scan is no longer stored."""
    rest: RestEvidence | None = None
    """Evidence against the claim of standstill; None like ``verdict``."""
    scale: float | None = None
    """Change of scale since an earlier revolution, as a factor on the ranges; None without a change."""
    front: str = ""
    """Scan odometry in use."""
    stands: StandingBody | None = None
    """Evidence that the body stands although its wheels roll; None without."""
    delay: Delay | None = None
    """Answer to the question about the lag."""

    @property
    def errors(self) -> tuple[float, float]:
        """Standard deviations of the place ahead (m) and of the yaw (rad): the larger of stated and scattered."""
        return max(self.deviations[0], self.scatter[0]), max(self.deviations[1], self.scatter[1])
