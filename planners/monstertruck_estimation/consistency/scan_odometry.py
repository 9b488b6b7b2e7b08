"""Worker of the consistency check: scan odometry, independent of the robot's wheels, compass and map.

``monstertruck_estimation.consistency.scan_odometry:warmed``; a step's input is a ``StepInput``, its output a
``StepOutput``. kiss-icp (Vizzo et al. 2023) registers each scan to its own voxel map, starting at the previous motion.
Our registration to the last scan that was kept refines its pose, and replaces it if kiss-icp is not installed.
"""

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import replace
from importlib.util import find_spec
from typing import Final

import numpy as np

from monstertruck_estimation.consistency.delay import scan_delay
from monstertruck_estimation.consistency.exchange import IN_USE, Claim, RestEvidence, ScanVerdict, StepInput, StepOutput
from monstertruck_estimation.consistency.rest_proof import rest_evidence
from monstertruck_estimation.consistency.scale import Revolution, ScaleWatch
from monstertruck_estimation.consistency.standing import StandingWatch, place_covariance, spread
from monstertruck_estimation.consistency.tracks import KEPT
from monstertruck_estimation.slam.registration import Cloud, Fit, fitting, measure, register
from monstertruck_estimation.slam.scans import Scan, prepare_input, scans_in_a_room
from monstertruck_kinematics.elementary import Array
from monstertruck_kinematics.se2 import between, compose
from monstertruck_runtime.clock import SECOND
from monstertruck_schemas.state import StandingBody

GAP: Final = 1.5
"""Maximum time between scans that are compared (s)."""


class KissFront:
    """kiss-icp's registration to its own voxel map."""

    def __init__(self) -> None:
        from monstertruck_estimation.slam.kiss import KissMap  # noqa: PLC0415  # its library is for this only

        self._map = KissMap()

    def begin(self, scan: Scan, pose: Array) -> None:
        """Forget everything, and start with ``scan`` at ``pose``, shape (3,)."""
        self._map.clear()
        self.keep(scan, pose)

    def match(self, scan: Scan, guess: Array) -> Array:
        """Return the pose of the next scan, shape (3,), from a guess."""
        return self._map.align(scan.points, guess)

    def keep(self, scan: Scan, pose: Array) -> None:
        """Add a scan with an accepted pose to the map."""
        self._map.update(scan.points, pose)


def front_of(kind: str) -> tuple[str, KissFront | None]:
    """Return the scan odometry of this name, or ours if kiss-icp is not installed, with its name."""
    if kind == "kiss" and find_spec("kiss_icp") is not None:
        return "kiss", KissFront()
    return "own", None


class ScanMotionStep:
    """Computes the motion between consecutive scans."""

    def __init__(self) -> None:
        self._front: tuple[str, KissFront | None] | None = None
        self._pose = np.zeros(3)
        # Number of motions whose mean velocity deskews the next scan. With one, the registration error feeds back into
        # the next scan and grows where only the last beams constrain the motion. With two it decays if a sweep takes no
        # longer than the interval between scans.
        averaged = 2
        self._motions: deque[tuple[Array, float]] = deque(maxlen=averaged)
        """Latest motions with their durations (s)."""
        scattered = 20  # number of the latest changes of the motion whose scatter is measured
        self._changes: deque[tuple[float, float]] = deque(maxlen=scattered)
        """Changes from one motion to the next (m^2, rad^2)."""
        self._last: tuple[int, Cloud] | None = None
        self._scale = ScaleWatch()
        self._scanned: int | None = None
        """Stamp of the last scan, also of one with too few points (ns)."""
        self._reference: tuple[Cloud, Array] | None = None
        """Reference scan of the registration, and its pose."""
        self._kept: deque[tuple[int, Scan, Array]] = deque(maxlen=128)  # number of scans kept for claims
        """Stamp, scan and its pose."""
        self._standing: StandingWatch | None = None

    def step(self, inputs: StepInput) -> StepOutput:
        """Take one scan."""
        output = self._take(inputs)
        return output if inputs.lag is None else replace(output, delay=scan_delay(inputs.lag))

    def _take(self, inputs: StepInput) -> StepOutput:
        if self._front is None:
            self._front = front_of(inputs.front)
        name, front = self._front
        stamp, last = inputs.scan.stamp, None if inputs.anew else self._last
        if self._scanned is not None and stamp - self._scanned > IN_USE:
            self._scale.restart(None)
        self._scanned = stamp
        dt = math.inf if last is None else (stamp - last[0]) / SECOND
        follows = bool(self._motions) and 0.0 < dt < GAP
        lasting, twist = np.zeros(3), np.zeros(3)
        if follows:
            motion, seconds = self._motions[-1]
            lasting = motion * (dt / seconds)
            twist = np.sum([moved for moved, _ in self._motions], axis=0) / sum(seconds for _, seconds in self._motions)
        vx, vy, wz = twist.tolist()
        whole = prepare_input(inputs.scan, 30.0, (vx, vy, wz))  # longer ranges are not used, m
        thinned = 0.06  # about one point per square of this edge is registered, m
        most_points = 300
        scan = whole.downsampled(thinned, most_points)
        if len(whole) < 30:  # minimum number of points of a scan that measures the motion
            self._last = None
            self._scale.begin(None)
            return StepOutput(stamp, None, front=name)
        found = None
        if last is not None and 0.0 < dt < GAP:
            found = self._found(front, scan, whole, last[1], lasting)
        self._last = stamp, Cloud.of(whole)
        factor = self._scale_change(inputs, whole, dt, [lasting if found is None else found[0], np.zeros(3)])
        if found is None or last is None:
            self._begin(front, scan, self._pose)
            self._motions.clear()
            self._standing = None
            self._changes.clear()
            self._kept.clear()
            self._kept.append((stamp, whole, self._pose))
            return StepOutput(stamp, None, scale=factor, front=name)
        motion, overlap, fit, widened = found
        deviations = deviations_of(fit)
        self._pose = compose(self._pose, motion)
        self._keep(front, scan)
        if follows:
            changed = motion - lasting
            self._changes.append((float(changed[:2] @ changed[:2]), float(changed[2] ** 2)))
        self._motions.append((motion, dt))
        self._kept.append((stamp, whole, self._pose))
        while stamp - self._kept[0][0] > KEPT:
            self._kept.popleft()
        verdict, rest = self._judged(whole, inputs.claim), self._evidence(whole, inputs)
        x, y, yaw = motion.tolist()
        scatter = scatter_of(self._changes)
        stands = self._stands(inputs, last[0], motion, place_covariance(fit, widened))
        return StepOutput(
            stamp, last[0], (x, y, yaw), deviations, scatter, overlap, verdict, rest, factor, name, stands
        )

    def _stands(self, inputs: StepInput, since: int, motion: Array, covariance: Array) -> StandingBody | None:
        if inputs.rolled is None:
            self._standing = None
            return None
        self._standing = self._standing or StandingWatch(inputs.slip, inputs.delay, inputs.drift)
        return self._standing.observe(since, inputs.scan.stamp, np.array(inputs.rolled), motion, covariance)

    def _scale_change(self, inputs: StepInput, whole: Scan, dt: float, motions: list[Array]) -> float | None:
        newest = Revolution(whole, inputs.scan.mount[:2])
        if inputs.rolled is None or not 0.0 < dt < GAP:
            self._scale.begin(newest)
            return None
        return self._scale.change(newest, [*motions, np.array(inputs.rolled)])

    def _begin(self, front: KissFront | None, scan: Scan, pose: Array) -> None:
        self._reference = Cloud.of(scan), pose
        if front is not None:
            front.begin(scan, pose)

    def _keep(self, front: KissFront | None, scan: Scan) -> None:
        if front is not None:
            front.keep(scan, self._pose)
        assert self._reference is not None
        moved = between(self._reference[1], self._pose)
        keep_way = 0.3  # maximum distance from the reference scan, m
        if math.hypot(moved[0], moved[1]) > keep_way or abs(moved[2]) > 0.35:  # maximum turn, rad
            self._reference = Cloud.of(scan), self._pose

    def _found(
        self, front: KissFront | None, scan: Scan, whole: Scan, before: Cloud, lasting: Array
    ) -> tuple[Array, float, Fit, float] | None:
        """Return the motion since the previous scan, its overlap, fit and ``spread``; None if no motion fits.

        While the robot starts moving, kiss-icp's pairs of points on walls along the path hold its pose back by up to
        0.1 m. Its pose is therefore only the initial guess for the registration to the reference, whose pairs slide
        along surfaces.
        """
        assert self._reference is not None
        cloud, origin = self._reference
        guess = compose(self._pose, lasting)
        if front is not None:
            guess = front.match(scan, guess)
        fit = register(scan, cloud, between(origin, guess)) if np.isfinite(guess).all() else None
        fits = 0.5  # minimum overlap of a valid motion with the previous scan
        if fit is not None and np.isfinite(fit.pose).all():
            motion = between(self._pose, compose(origin, fit.pose))
            overlap = measure(whole, before, motion).overlap
            if overlap >= fits:
                return motion, overlap, fit, spread(fit, scan, cloud)
        # The velocity has changed, or the map holds objects that have gone.
        tries = [register(whole, before, start) for start in (np.zeros(3), lasting)]
        best = max(tries, key=lambda fit: fit.overlap)
        if best.overlap < fits:
            return None
        self._begin(front, scan, compose(self._pose, best.pose))
        return best.pose, best.overlap, best, spread(best, whole, before)

    def _since(self, claim: Claim | None) -> tuple[int, Scan, Array] | None:
        return None if claim is None else next((kept for kept in self._kept if kept[0] == claim.since), None)

    def _evidence(self, scan: Scan, inputs: StepInput) -> RestEvidence | None:
        claim, earlier = inputs.rest, self._since(inputs.rest)
        if claim is None or earlier is None:
            return None
        return rest_evidence(scan, earlier[1], between(earlier[2], self._pose), claim, inputs.scan.mount[:2])

    def _judged(self, scan: Scan, claim: Claim | None) -> ScanVerdict | None:
        earlier = self._since(claim)
        if claim is None or earlier is None:
            return None
        cloud = Cloud.of(earlier[1])
        own = between(earlier[2], self._pose)
        claimed = np.array((*(own[:2] if claim.way is None else claim.way), claim.turn))
        steps = 10  # number of steps that refine a motion over a window: scan odometry drifts
        refined = [register(scan, cloud, start, iterations=steps).pose for start in (own, claimed)]
        fits_own = fitting(scan, cloud, refined[0])
        near = [pose for pose in refined if _is_near(pose, claimed, claim.errors)]
        fits = max((fitting(scan, cloud, pose) for pose in (claimed, *near)), key=np.count_nonzero)
        alone, own_alone, misfits = map(np.count_nonzero, (fits & ~fits_own, fits_own & ~fits, ~fits_own))
        return ScanVerdict(claimed=int(alone), own=int(own_alone), misfits=int(misfits))


def warmed() -> ScanMotionStep:
    """Build the step of a worker after loading its libraries and kernels, so that the first scan meets its deadline."""
    step = ScanMotionStep()
    for scan in scans_in_a_room():
        step.step(StepInput(scan, "kiss", rolled=(0.2, 0.0, 0.0)))
    return ScanMotionStep()


def deviations_of(fit: Fit) -> tuple[float, float]:
    """Return standard deviations of a registered pose ahead (m) and of its yaw (rad); 1 where unconstrained."""
    covariance = np.linalg.inv(fit.information + np.eye(3))
    c, s = math.cos(fit.pose[2]), math.sin(fit.pose[2])
    ahead = c * c * covariance[0, 0] + 2 * c * s * covariance[0, 1] + s * s * covariance[1, 1]
    return math.sqrt(ahead), math.sqrt(covariance[2, 2])


def scatter_of(changes: Sequence[tuple[float, float]]) -> tuple[float, float]:
    """Return standard deviations (m, rad) of places whose second differences have these squares; 6 variances each."""
    if not changes:
        return 0.0, 0.0
    ahead, turn = (math.sqrt(math.fsum(squares) / len(changes) / 6) for squares in zip(*changes, strict=True))
    return ahead, turn


def _is_near(pose: Array, claimed: Array, errors: tuple[float, float]) -> bool:
    off = between(claimed, pose)
    return math.hypot(off[0], off[1]) <= errors[0] and abs(float(off[2])) <= errors[1]
