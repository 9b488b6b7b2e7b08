"""What may happen to the belief, each at its instant."""

import math
from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from monstertruck_estimation.fusion.compass_gate import Evidence, Gate, Verdict, judged
from monstertruck_estimation.fusion.config import LASTING, FusionConfig
from monstertruck_estimation.se2 import between, between_jacobians, rotation
from monstertruck_estimation.transforms import wrap_angle
from monstertruck_kinematics.motion import integrate, integration_jacobians
from monstertruck_runtime.clock import SECOND

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class WheelWay:
    """The base moved by ``delta`` (dx, dy, dyaw in base at ``since``), say the wheels."""

    since: int
    stamp: int
    delta: Array
    """Shape (3,), m and rad, as if on level ground."""
    covariance: Array
    """Shape (3, 3)."""
    slipping: bool = False
    """The wheels are known not to hold the ground."""


@dataclass(frozen=True, slots=True)
class ScanWay:
    """The base moved by ``delta`` between two scans."""

    since: int
    stamp: int
    delta: Array
    """Shape (3,), m and rad."""
    covariance: Array
    """Shape (3, 3), of the later scan's place on the map both are matched to, in base's axes; huge along a corridor."""


@dataclass(frozen=True, slots=True)
class ScanMark:
    """A scan was taken; a later one will tell how the base moved since."""

    stamp: int
    covariance: Array
    """Shape (3, 3), of its place, as in ``ScanWay``."""


@dataclass(frozen=True, slots=True)
class Heading:
    """A reading of the compass."""

    stamp: int
    yaw: float
    """Counter-clockwise from magnetic north, rad."""
    disturbed: bool = False
    """The device itself says so."""
    taken_back: bool = False
    """A disturbance was noticed soon after it."""
    field: float | None = None
    """Strength of the magnetic field, in the device's unit."""
    tilt: tuple[float, float] | None = None
    """Roll and pitch, rad, while they are tilt."""


Operation = WheelWay | ScanWay | ScanMark | Heading


SIZE: Final = 15
POSE: Final = slice(0, 3)
TWIST: Final = slice(3, 6)
YAW, NORTH, TRIM = 2, 6, 7
SCAN: Final = slice(8, 11)
WHEELS: Final = slice(11, 14)
LOCAL: Final = 14
LATER: Final = slice(15, 18)
"""Place of the scan that is just being taken in."""
IDENTITY: Final = np.eye(SIZE)
LARGER: Final = np.eye(SIZE + 3)
AT_REST: Final = 0.05
"""Standard deviation of the velocity at the start, m/s and rad/s."""
QUANTUM: Final = (1e-5, 1e-5)
"""Standard deviation of a wheel reading that did not move, m and rad: standing costs no certainty."""
MOVED_BY: Final = ("drive", "lidar")
"""Sensors that tell motion."""
STOPPING: Final = 0.1
"""Time constant with which the velocity dies away when all of them are silent, s."""
FRESH: Final = SECOND // 2
"""Tilt counts for this long, ns."""


@dataclass(frozen=True, slots=True)
class Belief:
    """What is believed at one instant."""

    stamp: int
    mean: Array
    """Shape (15,)."""
    covariance: Array
    """Shape (15, 15)."""
    scan: int | None = None
    """Stamp of the clone at the last scan."""
    wheels: int | None = None
    """Stamp of the clone at the last wheel reading."""
    gate: Gate = field(default_factory=Gate)
    tilt: tuple[int, float, float] | None = None
    """Stamp, roll, pitch."""
    used: dict[str, int] = field(default_factory=dict)
    """Stamp at which every sensor was last used."""
    nis: float = 0.0
    """Normalised innovation squared of the last update."""

    def estimated(self, mean: Array, covariance: Array, stamp: int | None = None, nis: float | None = None) -> "Belief":
        """The same with another estimate: what ``dataclasses.replace`` does, in a tenth of its time."""
        return Belief(
            self.stamp if stamp is None else stamp,
            mean,
            covariance,
            self.scan,
            self.wheels,
            self.gate,
            self.tilt,
            self.used,
            self.nis if nis is None else nis,
        )


def initial(stamp: int, config: FusionConfig) -> Belief:
    """The start: the pose is known by definition, the truck stands."""
    mean = np.zeros(SIZE)
    mean[POSE] = config.start.x, config.start.y, config.start.yaw
    trim = config.wheels.trim if config.wheels is not None else 0.0
    spread = np.zeros(SIZE)
    spread[TWIST], spread[NORTH], spread[TRIM] = AT_REST, math.pi, trim
    spread[LOCAL] = config.compass.local if config.compass is not None else 0.0
    return Belief(stamp, mean, np.diag(spread**2))


def predicted(belief: Belief, stamp: int, config: FusionConfig) -> Belief:
    """The belief at a later instant (ns): the velocity dies away (Gauss-Markov), the pose follows the arc."""
    dt = (stamp - belief.stamp) / SECOND
    if dt <= 0:
        return belief
    moved = max((belief.used[name] for name in MOVED_BY if name in belief.used), default=stamp)
    blind = stamp - moved > config.max_prediction * SECOND
    lasting = STOPPING if blind else config.persistence
    keep = math.exp(-dt / lasting)
    span = lasting * (1.0 - keep)
    mean = belief.mean.copy()
    x, y, yaw, vx, vy, wz = mean[:6].tolist()
    by_pose, by_twist = integration_jacobians((x, y, yaw), vx, vy, wz, span)
    mean[POSE] = integrate((x, y, yaw), vx, vy, wz, span)
    mean[TWIST] *= keep
    step = IDENTITY.copy()
    step[POSE, POSE], step[POSE, TWIST] = by_pose, by_twist
    step[TWIST, TWIST] *= keep
    like = math.exp(-(math.hypot(vx, vy) / LASTING[0] + abs(wz) / LASTING[1]) * span)
    mean[LOCAL] *= like
    step[LOCAL, LOCAL] = like
    covariance = step @ belief.covariance @ step.T
    agility = np.square(config.agility)
    turned = by_twist / span
    covariance[POSE, POSE] += turned * (agility * dt**3 / 3) @ turned.T
    cross = turned * (agility * dt**2 / 2)
    covariance[POSE, TWIST] += cross
    covariance[TWIST, POSE] += cross.T
    covariance[TWIST, TWIST] += np.diag(agility * dt)
    if config.compass is not None:
        covariance[NORTH, NORTH] += config.compass.drift**2 * dt
        covariance[LOCAL, LOCAL] += config.compass.local**2 * (1 - like**2)
    covariance[TRIM, TRIM] += (config.wheels.trim_drift**2 if config.wheels is not None else 0.0) * dt
    return belief.estimated(mean, (covariance + covariance.T) / 2, stamp)


def advanced(belief: Belief, operation: Operation, config: FusionConfig) -> Belief:
    """The belief after an operation that is not earlier."""
    belief = predicted(belief, operation.stamp, config)
    match operation:
        case WheelWay():
            return _wheels(belief, operation, config)
        case ScanWay():
            return _scan(belief, operation, config)
        case ScanMark():
            return _marked(belief, operation.stamp, operation.covariance)
        case Heading():
            return _heading(belief, operation, config)


def updated(belief: Belief, residual: Array, by_state: Array, noise: Array) -> Belief:
    """Kalman's update in Joseph's form.

    Args:
        belief: prior.
        residual: shape (m,), measured minus expected.
        by_state: shape (m, n), derivative of the expected by the state.
        noise: shape (m, m), covariance of the measurement.
    """
    spread = by_state @ belief.covariance
    innovation = spread @ by_state.T + noise
    inverse: Array = np.asarray(np.linalg.inv(innovation), np.float64) if len(residual) > 1 else 1.0 / innovation
    gain = spread.T @ inverse
    left = LARGER[: len(belief.mean), : len(belief.mean)] - gain @ by_state
    covariance = left @ belief.covariance @ left.T + gain @ noise @ gain.T
    nis = float(residual @ inverse @ residual)
    return belief.estimated(belief.mean + gain @ residual, (covariance + covariance.T) / 2, nis=nis)


def _way(belief: Belief, clone: slice, delta: Array) -> tuple[Array, Array]:
    """Residual, shape (3,), and derivative, (3, 15), of a motion since a clone."""
    then, now = belief.mean[clone], belief.mean[POSE]
    residual = delta - between(then, now)
    residual[2] = wrap_angle(float(residual[2]))
    by_state = np.zeros((3, SIZE))
    by_state[:, clone], by_state[:, POSE] = between_jacobians(then, now)
    return residual, by_state


def _wheels(belief: Belief, way: WheelWay, config: FusionConfig) -> Belief:
    slip, used = config.slip, belief.used
    if belief.wheels == way.since:
        level = np.array((*_level(belief), 1.0))
        delta, dt = way.delta * level, (way.stamp - way.since) / SECOND
        residual, by_state = _way(belief, WHEELS, delta)
        signed = math.copysign(math.hypot(delta[0], delta[1]), delta[0])
        residual[2] -= belief.mean[TRIM] * signed
        by_state[2, TRIM] = signed
        noise = way.covariance + np.diag((QUANTUM[0] ** 2, QUANTUM[0] ** 2, QUANTUM[1] ** 2))
        if way.slipping:
            noise = noise + np.diag(np.square((slip.speed * dt, slip.speed * dt, slip.turn * dt)))
        belief = updated(belief, residual, by_state, noise)
        if not way.slipping:
            used = {**used, "drive": way.stamp}
    mean, covariance = _cloned(belief, WHEELS)
    return replace(belief, mean=mean, covariance=covariance, wheels=way.stamp, used=used)


def _level(belief: Belief) -> tuple[float, float]:
    """Share of a way along x and along y that is level."""
    if belief.tilt is None or belief.stamp - belief.tilt[0] > FRESH:
        return 1.0, 1.0
    return math.cos(belief.tilt[2]), math.cos(belief.tilt[1])


def _scan(belief: Belief, way: ScanWay, config: FusionConfig) -> Belief:
    """The later scan's place joins the state, the motion ties it to the earlier one's, and it takes over."""
    if belief.scan != way.since or config.scans is None:
        return _marked(belief, way.stamp, way.covariance)
    by_place = np.vstack((np.eye(SIZE), np.zeros((3, SIZE))))
    by_place[LATER, POSE] = np.eye(3)
    mean = by_place @ belief.mean
    covariance = by_place @ belief.covariance @ by_place.T
    covariance[LATER, LATER] += _turned(way.covariance, float(belief.mean[YAW]))
    earlier, later = mean[SCAN], mean[LATER]
    residual = way.delta - between(earlier, later)
    residual[2] = wrap_angle(float(residual[2]))
    by_state = np.zeros((3, SIZE + 3))
    by_state[:, SCAN], by_state[:, LATER] = between_jacobians(earlier, later)
    place, turn = config.scans.drift
    noise = np.diag((place**2, place**2, turn**2))
    joint = updated(belief.estimated(mean, covariance), residual, by_state, noise)
    kept = np.r_[0:SIZE]
    kept[SCAN] = np.r_[LATER]
    return replace(
        joint,
        mean=joint.mean[kept],
        covariance=joint.covariance[np.ix_(kept, kept)],
        scan=way.stamp,
        used={**belief.used, "lidar": way.stamp},
    )


def _turned(covariance: Array, yaw: float) -> Array:
    """A covariance given in base's axes, in those of odom."""
    turn = np.eye(3)
    turn[:2, :2] = rotation(yaw)
    result: Array = turn @ covariance @ turn.T
    return (result + result.T) / 2


def _marked(belief: Belief, stamp: int, noise: Array) -> Belief:
    """The pose as a scan sees it becomes the clone of the scan."""
    mean, covariance = _cloned(belief, SCAN)
    covariance[SCAN, SCAN] += _turned(noise, float(mean[YAW]))
    return replace(belief, mean=mean, covariance=covariance, scan=stamp)


def _cloned(belief: Belief, clone: slice) -> tuple[Array, Array]:
    """Mean and covariance with the pose as it is now as the clone."""
    mean, covariance = belief.mean.copy(), belief.covariance.copy()
    mean[clone] = mean[POSE]
    covariance[clone, :] = covariance[POSE, :]
    covariance[:, clone] = covariance[:, POSE]
    return mean, covariance


def _heading(belief: Belief, heading: Heading, config: FusionConfig) -> Belief:
    if heading.tilt is not None:
        used = {**belief.used, "tilt": heading.stamp}
        belief = replace(belief, tilt=(heading.stamp, *heading.tilt), used=used)
    if config.compass is None:
        return belief
    mean, covariance = belief.mean, belief.covariance
    by_state = np.zeros((1, SIZE))
    by_state[0, YAW], by_state[0, NORTH], by_state[0, LOCAL] = 1.0, -1.0, 1.0
    residual = float(_residual(belief, heading)[0])
    evidence = Evidence(
        stamp=heading.stamp,
        place=(float(mean[0]), float(mean[1]), float(mean[YAW])),
        residual=residual,
        variance=float((by_state @ covariance @ by_state.T).item()),
        yaw_variance=float(covariance[YAW, YAW]),
        north=(float(mean[NORTH]), float(covariance[NORTH, NORTH])),
        local=float(mean[LOCAL]),
        flagged=heading.disturbed,
        taken_back=heading.taken_back,
        field=heading.field,
    )
    before = belief.gate
    verdict, gate = judged(before, evidence, config.compass)
    if gate.disturbed and not before.disturbed:
        belief = _elsewhere(belief, config.compass.local)
    belief = replace(belief, gate=gate)
    noise = config.compass.noise**2
    if verdict is Verdict.LEFT_OUT:
        return belief
    if verdict is Verdict.ANCHORED:
        belief = _anchored(belief, wrap_angle(float(mean[YAW] + mean[LOCAL]) - heading.yaw), noise)
    elif verdict is Verdict.HOME and gate.home is not None:
        belief = _returned(belief, *gate.home)
        belief = updated(belief, _residual(belief, heading), by_state, np.array([[noise]]))
    else:
        belief = updated(belief, np.array([residual]), by_state, np.array([[noise]]))
    return replace(belief, used={**belief.used, "compass": heading.stamp})


def _residual(belief: Belief, heading: Heading) -> Array:
    return np.array([wrap_angle(heading.yaw - float(belief.mean[YAW] - belief.mean[NORTH] + belief.mean[LOCAL]))])


def _anchored(belief: Belief, north: float, noise: float) -> Belief:
    """North follows from yaw, heading and deviation: their errors add up in it."""
    mean, by_state = belief.mean.copy(), np.eye(SIZE)
    mean[NORTH] = north
    by_state[NORTH, :] = 0.0
    by_state[NORTH, [YAW, LOCAL]] = 1.0
    covariance = by_state @ belief.covariance @ by_state.T
    covariance[NORTH, NORTH] += noise
    return replace(belief, mean=mean, covariance=covariance)


def _elsewhere(belief: Belief, deviation: float) -> Belief:
    """What was taken for the local deviation was a disturbance; nothing is known of the one to come."""
    mean, covariance = belief.mean.copy(), belief.covariance.copy()
    mean[LOCAL] = 0.0
    covariance[LOCAL, :] = 0.0
    covariance[:, LOCAL] = 0.0
    covariance[LOCAL, LOCAL] = deviation**2
    return replace(belief, mean=mean, covariance=covariance)


def _returned(belief: Belief, north: float, variance: float) -> Belief:
    """North is what it was before the disturbance."""
    mean, covariance = belief.mean.copy(), belief.covariance.copy()
    mean[NORTH] = north
    covariance[NORTH, :] = 0.0
    covariance[:, NORTH] = 0.0
    covariance[NORTH, NORTH] = variance
    return replace(belief, mean=mean, covariance=covariance)
