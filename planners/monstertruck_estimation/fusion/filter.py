"""Error-state extended Kalman filter with stochastic clones, as pure functions of a frozen state."""

import math
from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np

from monstertruck_estimation.fusion.compass_gate import CompassGate, HeadingInnovation, HeadingUse, gate_heading
from monstertruck_estimation.fusion.config import DEVIATION_SCALE, FusionConfig
from monstertruck_estimation.transforms import wrap_angle
from monstertruck_kinematics.elementary import Array
from monstertruck_kinematics.se2 import between, between_jacobians, integrate, integration_jacobians, rotation
from monstertruck_runtime.clock import SECOND


@dataclass(frozen=True, slots=True)
class WheelMeasurement:
    """Motion of base ``delta`` (dx, dy, dyaw in base at ``since``) by the wheels."""

    since: int
    stamp: int
    delta: Array
    """Motion, shape (3,) (m, rad), as if on level ground."""
    covariance: Array
    """Covariance of the motion, shape (3, 3)."""
    slipping: bool = False
    """Whether the wheels slipped during the measurement."""
    turn: tuple[float, float] | None = None
    """Turn by a gyroscope in the same time (rad), and its variance (rad^2)."""
    tilt: tuple[float, float] | None = None
    """Roll and pitch by an IMU (rad)."""


@dataclass(frozen=True, slots=True)
class ScanMeasurement:
    """Motion of base ``delta`` between two scans."""

    since: int
    stamp: int
    delta: Array
    """Motion, shape (3,) (m, rad)."""
    covariance: Array
    """Covariance, shape (3, 3), of the later scan's place on the map both are matched to, in base's axes; huge along a
    corridor."""


@dataclass(frozen=True, slots=True)
class ScanClone:
    """A scan whose pose is cloned, to relate a later scan to it."""

    stamp: int
    covariance: Array
    """Covariance of its place, shape (3, 3), as in ``ScanMeasurement``."""


@dataclass(frozen=True, slots=True)
class HeadingMeasurement:
    """Reading of the compass."""

    stamp: int
    yaw: float
    """Yaw, counter-clockwise from magnetic north (rad)."""
    disturbed: bool = False
    """Whether the device flags the reading as disturbed."""
    taken_back: bool = False
    """Whether a disturbance was detected soon after the reading."""
    field: float | None = None
    """Strength of the magnetic field, in the device's unit."""
    tilt: tuple[float, float] | None = None
    """Roll and pitch (rad), if valid."""
    jump: float | None = None
    """Jump of the headings at this reading (rad), as found on its arrival; None before."""


Measurement = WheelMeasurement | ScanMeasurement | ScanClone | HeadingMeasurement


STATE_SIZE: Final = 15
POSE: Final = slice(0, 3)
TWIST: Final = slice(3, 6)
YAW, NORTH, TRIM = 2, 6, 7
SCAN: Final = slice(8, 11)
WHEELS: Final = slice(11, 14)
LOCAL: Final = 14
LATER: Final = slice(15, 18)
"""Pose of the scan in the current update."""
IDENTITY: Final = np.eye(STATE_SIZE)
LARGER: Final = np.eye(STATE_SIZE + 3)
MOVED_BY: Final = ("drive", "lidar")
"""Sensors that measure motion."""
TURNED_BY: Final = ("imu", "lidar")
"""Sensors that measure turns without wheel slip."""
TILT_VALID: Final = SECOND // 2
"""Time for which a tilt is used (ns)."""


@dataclass(frozen=True, slots=True)
class FilterState:
    """Mean, covariance and clones at one instant."""

    stamp: int
    mean: Array
    """Shape (15,)."""
    covariance: Array
    """Shape (15, 15)."""
    scan: int | None = None
    """Stamp of the clone at the last scan."""
    wheels: int | None = None
    """Stamp of the clone at the last wheel reading."""
    gate: CompassGate = field(default_factory=CompassGate)
    tilt: tuple[int, float, float] | None = None
    """Stamp (ns), roll, pitch."""
    used: dict[str, int] = field(default_factory=dict)
    """Stamp at which every sensor was last used."""
    nis: float = 0.0
    """Normalised innovation squared of the last update."""

    def estimated(
        self, mean: Array, covariance: Array, stamp: int | None = None, nis: float | None = None
    ) -> "FilterState":
        """Return the state with a different estimate: ``dataclasses.replace`` in a tenth of its time."""
        return FilterState(
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


def initial_state(stamp: int, config: FusionConfig) -> FilterState:
    """Return the state at the start: the pose is known by definition, and the truck stands."""
    mean = np.zeros(STATE_SIZE)
    mean[POSE] = config.start.x, config.start.y, config.start.yaw
    trim = config.wheels.trim if config.wheels is not None else 0.0
    spread = np.zeros(STATE_SIZE)
    # 0.05: standard deviation of the velocity at the start, m/s and rad/s
    spread[TWIST], spread[NORTH], spread[TRIM] = 0.05, math.pi, trim
    spread[LOCAL] = config.compass.local if config.compass is not None else 0.0
    return FilterState(stamp, mean, np.diag(spread**2))


def predict(state: FilterState, stamp: int, config: FusionConfig) -> FilterState:
    """Return the state at a later instant (ns): the velocity decays (Gauss-Markov), the pose follows the arc."""
    dt = (stamp - state.stamp) / SECOND
    if dt <= 0:
        return state
    moved = max((state.used[name] for name in MOVED_BY if name in state.used), default=stamp)
    blind = stamp - moved > config.max_prediction * SECOND
    # 0.1: time constant with which the velocity decays when all sensors are silent, s
    lasting = 0.1 if blind else config.persistence
    keep = math.exp(-dt / lasting)
    span = lasting * (1.0 - keep)
    mean = state.mean.copy()
    x, y, yaw, vx, vy, wz = mean[:6].tolist()
    by_pose, by_twist = integration_jacobians((x, y, yaw), vx, vy, wz, span)
    mean[POSE] = integrate((x, y, yaw), vx, vy, wz, span)
    mean[TWIST] *= keep
    step = IDENTITY.copy()
    step[POSE, POSE], step[POSE, TWIST] = by_pose, by_twist
    step[TWIST, TWIST] *= keep
    like = math.exp(-(math.hypot(vx, vy) / DEVIATION_SCALE[0] + abs(wz) / DEVIATION_SCALE[1]) * span)
    mean[LOCAL] *= like
    step[LOCAL, LOCAL] = like
    covariance = step @ state.covariance @ step.T
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
    return state.estimated(mean, (covariance + covariance.T) / 2, stamp)


def apply_measurement(state: FilterState, measurement: Measurement, config: FusionConfig) -> FilterState:
    """Predict to the measurement's stamp, which must not be before the state's stamp, and apply the measurement."""
    state = predict(state, measurement.stamp, config)
    match measurement:
        case WheelMeasurement():
            return _wheels(state, measurement, config)
        case ScanMeasurement():
            return _scan(state, measurement, config)
        case ScanClone():
            return _marked(state, measurement.stamp, measurement.covariance)
        case HeadingMeasurement():
            return _heading(state, measurement, config)


def kalman_update(state: FilterState, residual: Array, by_state: Array, noise: Array) -> FilterState:
    """Kalman update in Joseph form.

    Args:
        state: prior.
        residual: measured minus expected, shape (m,).
        by_state: derivative of the expected by the state, shape (m, n).
        noise: covariance of the measurement, shape (m, m).
    """
    spread = by_state @ state.covariance
    innovation = spread @ by_state.T + noise
    inverse: Array = np.asarray(np.linalg.inv(innovation), np.float64) if len(residual) > 1 else 1.0 / innovation
    gain = spread.T @ inverse
    left = LARGER[: len(state.mean), : len(state.mean)] - gain @ by_state
    covariance = left @ state.covariance @ left.T + gain @ noise @ gain.T
    nis = float(residual @ inverse @ residual)
    return state.estimated(state.mean + gain @ residual, (covariance + covariance.T) / 2, nis=nis)


def _motion_residual(state: FilterState, clone: slice, delta: Array) -> tuple[Array, Array]:
    """Return residual, shape (3,), and derivative, (3, 15), of a motion since a clone."""
    then, now = state.mean[clone], state.mean[POSE]
    residual = delta - between(then, now)
    residual[2] = wrap_angle(float(residual[2]))
    by_state = np.zeros((3, STATE_SIZE))
    by_state[:, clone], by_state[:, POSE] = between_jacobians(then, now)
    return residual, by_state


def _wheels(state: FilterState, measured: WheelMeasurement, config: FusionConfig) -> FilterState:
    slip, used = config.slip, state.used
    # standard deviation of a wheel reading that did not move, m and rad: status costs no certainty
    quantum = (1e-5, 1e-5)
    if state.wheels == measured.since:
        if measured.tilt is not None:
            used = {**used, "tilt": measured.stamp}
        level = np.array((*_level(state, measured.tilt), 1.0))
        delta, dt = measured.delta * level, (measured.stamp - measured.since) / SECOND
        residual, by_state = _motion_residual(state, WHEELS, delta)
        noise = measured.covariance + np.diag((quantum[0] ** 2, quantum[0] ** 2, quantum[1] ** 2))
        if measured.slipping:
            noise = noise + np.diag(np.square((slip.speed * dt, slip.speed * dt, slip.turn * dt)))
        if measured.turn is not None:
            turn, variance = measured.turn
            residual = np.append(residual, wrap_angle(turn - float(delta[2] - residual[2])))
            by_state = np.vstack((by_state, by_state[2]))
            wheels, noise = noise, np.zeros((4, 4))
            noise[:3, :3], noise[3, 3] = wheels, variance
            used = {**used, "imu": measured.stamp}
        signed = math.copysign(math.hypot(delta[0], delta[1]), delta[0])
        residual[2] -= state.mean[TRIM] * signed
        by_state[2, TRIM] = signed
        state = kalman_update(state, residual, by_state, noise)
        if not measured.slipping:
            used = {**used, "drive": measured.stamp}
    mean, covariance = _cloned(state, WHEELS)
    return replace(state, mean=mean, covariance=covariance, wheels=measured.stamp, used=used)


def _level(state: FilterState, felt: tuple[float, float] | None) -> tuple[float, float]:
    """Return the horizontal part of a motion along x and y; the compass has priority over the IMU's tilt ``felt``."""
    if state.tilt is not None and state.stamp - state.tilt[0] <= TILT_VALID:
        felt = state.tilt[1:]
    if felt is None:
        return 1.0, 1.0
    roll, pitch = felt
    return math.cos(pitch), math.cos(roll)


def _scan(state: FilterState, measured: ScanMeasurement, config: FusionConfig) -> FilterState:
    """Augment with the later scan's pose, update with the motion since the earlier one, then replace that clone."""
    if state.scan != measured.since or config.scans is None:
        return _marked(state, measured.stamp, measured.covariance)
    by_place = np.vstack((np.eye(STATE_SIZE), np.zeros((3, STATE_SIZE))))
    by_place[LATER, POSE] = np.eye(3)
    mean = by_place @ state.mean
    covariance = by_place @ state.covariance @ by_place.T
    covariance[LATER, LATER] += _turned(measured.covariance, float(state.mean[YAW]))
    earlier, later = mean[SCAN], mean[LATER]
    residual = measured.delta - between(earlier, later)
    residual[2] = wrap_angle(float(residual[2]))
    by_state = np.zeros((3, STATE_SIZE + 3))
    by_state[:, SCAN], by_state[:, LATER] = between_jacobians(earlier, later)
    place, turn = config.scans.drift
    noise = np.diag((place**2, place**2, turn**2))
    joint = kalman_update(state.estimated(mean, covariance), residual, by_state, noise)
    kept = np.r_[0:STATE_SIZE]
    kept[SCAN] = np.r_[LATER]
    return replace(
        joint,
        mean=joint.mean[kept],
        covariance=joint.covariance[np.ix_(kept, kept)],
        scan=measured.stamp,
        used={**state.used, "lidar": measured.stamp},
    )


def _turned(covariance: Array, yaw: float) -> Array:
    """Return a covariance in odom's axes, given in base's axes."""
    turn = np.eye(3)
    turn[:2, :2] = rotation(yaw)
    result: Array = turn @ covariance @ turn.T
    return (result + result.T) / 2


def _marked(state: FilterState, stamp: int, noise: Array) -> FilterState:
    """Clone the pose, with the error of the scan's match, as the clone of the scan."""
    mean, covariance = _cloned(state, SCAN)
    covariance[SCAN, SCAN] += _turned(noise, float(mean[YAW]))
    return replace(state, mean=mean, covariance=covariance, scan=stamp)


def _cloned(state: FilterState, clone: slice) -> tuple[Array, Array]:
    """Return mean and covariance with the clone replaced by the current pose."""
    mean, covariance = state.mean.copy(), state.covariance.copy()
    mean[clone] = mean[POSE]
    covariance[clone, :] = covariance[POSE, :]
    covariance[:, clone] = covariance[:, POSE]
    return mean, covariance


def _heading(state: FilterState, heading: HeadingMeasurement, config: FusionConfig) -> FilterState:
    if heading.tilt is not None:
        used = {**state.used, "tilt": heading.stamp}
        state = replace(state, tilt=(heading.stamp, *heading.tilt), used=used)
    if config.compass is None:
        return state
    mean, covariance = state.mean, state.covariance
    by_state = np.zeros((1, STATE_SIZE))
    by_state[0, YAW], by_state[0, NORTH], by_state[0, LOCAL] = 1.0, -1.0, 1.0
    residual = float(_residual(state, heading)[0])
    innovation = HeadingInnovation(
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
        jump=heading.jump,
        turn_known=_own_turn(state, heading.stamp, config),
    )
    before = state.gate
    verdict, gate = gate_heading(before, innovation, config.compass)
    if gate.disturbed and not before.disturbed:
        state = _elsewhere(state, config.compass.local)
    state = replace(state, gate=gate)
    noise = config.compass.noise**2
    if verdict is HeadingUse.LEFT_OUT:
        return state
    if verdict is HeadingUse.ANCHORED:
        state = _anchored(state, wrap_angle(float(mean[YAW] + mean[LOCAL]) - heading.yaw), noise)
    elif verdict is HeadingUse.HOME and gate.home is not None:
        state = _returned(state, *gate.home)
        state = kalman_update(state, _residual(state, heading), by_state, np.array([[noise]]))
    else:
        state = kalman_update(state, np.array([residual]), by_state, np.array([[noise]]))
    return replace(state, used={**state.used, "compass": heading.stamp})


def _own_turn(state: FilterState, stamp: int, config: FusionConfig) -> float:
    """Return the maximum turn (rad) that slipping wheels missed since the last used heading; 0 if it was measured."""
    if any(stamp - state.used[name] <= TILT_VALID for name in TURNED_BY if name in state.used):
        return 0.0
    return config.max_turn * (stamp - state.used.get("compass", stamp)) / SECOND


def _residual(state: FilterState, heading: HeadingMeasurement) -> Array:
    return np.array([wrap_angle(heading.yaw - float(state.mean[YAW] - state.mean[NORTH] + state.mean[LOCAL]))])


def _anchored(state: FilterState, north: float, noise: float) -> FilterState:
    """Initialise north from yaw, heading and deviation: their errors add up in it."""
    mean, by_state = state.mean.copy(), np.eye(STATE_SIZE)
    mean[NORTH] = north
    by_state[NORTH, :] = 0.0
    by_state[NORTH, [YAW, LOCAL]] = 1.0
    covariance = by_state @ state.covariance @ by_state.T
    covariance[NORTH, NORTH] += noise
    return replace(state, mean=mean, covariance=covariance)


def _elsewhere(state: FilterState, deviation: float) -> FilterState:
    """Reset the local deviation: its estimate followed a disturbance."""
    mean, covariance = state.mean.copy(), state.covariance.copy()
    mean[LOCAL] = 0.0
    covariance[LOCAL, :] = 0.0
    covariance[:, LOCAL] = 0.0
    covariance[LOCAL, LOCAL] = deviation**2
    return replace(state, mean=mean, covariance=covariance)


def _returned(state: FilterState, north: float, variance: float) -> FilterState:
    """Restore north from before the disturbance."""
    mean, covariance = state.mean.copy(), state.covariance.copy()
    mean[NORTH] = north
    covariance[NORTH, :] = 0.0
    covariance[:, NORTH] = 0.0
    covariance[NORTH, NORTH] = variance
    return replace(state, mean=mean, covariance=covariance)
