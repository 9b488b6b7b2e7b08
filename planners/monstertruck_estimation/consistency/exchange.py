"""Inputs and outputs of the scan odometry's worker; without numba, so that the daemon can import them."""

from dataclasses import dataclass
from typing import Final

from monstertruck_estimation.consistency.delay import SIGMAS, Delay, LagQuestion
from monstertruck_estimation.slam.worker_io import ScanInput
from monstertruck_kinematics.se2 import Pose2


@dataclass(frozen=True, slots=True)
class Claim:
    """A motion that another measure claims, to be judged by the scans at both of its ends."""

    since: int
    """Stamp of the earlier scan, ns."""
    way: tuple[float, float] | None
    """Place of base at the newest scan in base at the earlier one, m; None = as by the scans."""
    turn: float
    """Turn, rad."""
    errors: tuple[float, float]
    """How far, m and rad, the true motion may be from it if the measure works."""


@dataclass(frozen=True, slots=True)
class StepInput:
    """One scan."""

    scan: ScanInput
    front: str
    """Scan odometry, see ``ConsistencyConfig.scans``."""
    anew: bool = False
    """Forget the scans before."""
    claim: Claim | None = None
    lag: LagQuestion | None = None
    rest: Claim | None = None
    """That the robot stands, as far as its wheels do."""
    rolled: Pose2 | None = None
    """Motion by the wheels since the scan before; None = not known."""


REFUTING: Final = 12
"""Points that fit the scans' own motion alone with which a claim is refuted at least."""


@dataclass(frozen=True, slots=True)
class ScanVerdict:
    """How a claimed motion and the scans' own explain the newest scan: points that fit one of them alone.

    Both are refined, the claimed one within its errors: what counts is whether any motion near it fits.
    """

    claimed: int
    own: int
    misfits: int
    """Points that do not fit the scans' own motion."""

    @property
    def refuted(self) -> bool:
        """Whether the scans contradict the claim.

        Where nothing constrains the motion (a corridor, an open field), no point fits one alone. Among people who walk,
        some fit either, and many neither.
        """
        outweighed = 4  # their number for every point that fits the claim alone
        return self.own >= max(REFUTING + outweighed * self.claimed, self.misfits)


@dataclass(frozen=True, slots=True)
class RestEvidence:
    """Motion of the body that its wheels do not show."""

    motion: Pose2 = (0.0, 0.0, 0.0)
    """Pose of base at the newest scan, relative to the claimed pose, m and rad."""
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
    """Ns."""
    since: int | None
    """Stamp of the scan before; None = there is a gap: the motion since then is not known."""
    motion: Pose2 = (0.0, 0.0, 0.0)
    """Base at ``stamp`` in base at ``since``."""
    deviations: tuple[float, float] = (1.0, 1.0)
    """Standard deviations of the place ahead (m) and of the yaw (rad) at ``stamp``, against a scan that is kept for
    some steps: errors of one step are those of the next one with the other sign."""
    scatter: tuple[float, float] = (0.0, 0.0)
    """The same by how much the newest motions differ from each other: no robot goes to and fro from scan to scan."""
    overlap: float = 0.0
    """Share of the points that fit the scan before."""
    verdict: ScanVerdict | None = None
    """Of the claim; None without one, and where the earlier scan is not known any more."""
    rest: RestEvidence | None = None
    """Evidence against the claim of standstill; None like ``verdict``."""
    scale: float | None = None
    """Change of scale since an earlier revolution, as a factor on the ranges; None = no change."""
    front: str = ""
    """Scan odometry that is used."""
    delay: Delay | None = None
    """Answer to the question for the lag."""

    @property
    def errors(self) -> tuple[float, float]:
        """Standard deviations of the place ahead (m) and of the yaw (rad): as stated or as they scatter."""
        return max(self.deviations[0], self.scatter[0]), max(self.deviations[1], self.scatter[1])
