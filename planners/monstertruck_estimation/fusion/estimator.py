"""Sensor fusion into one pose: checks and orders measurements, and publishes a pose without jumps."""

import math
from bisect import bisect_left, bisect_right
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Final

import numpy as np

from monstertruck_estimation.correction import SmoothedCorrection
from monstertruck_estimation.fusion.config import FusionConfig
from monstertruck_estimation.fusion.filter import (
    MOVED_BY,
    POSE,
    TRIM,
    TWIST,
    FilterState,
    HeadingMeasurement,
    Measurement,
    ScanClone,
    ScanMeasurement,
    WheelMeasurement,
    apply_measurement,
    initial_state,
    predict,
)
from monstertruck_estimation.fusion.slip import SlipChange, SlipDetector
from monstertruck_estimation.heading_turns import HeadingTurns
from monstertruck_estimation.inertial import Inertial
from monstertruck_estimation.odometry import SOURCE_TIMEOUT, OdometryEstimate
from monstertruck_estimation.wheel_motion import WheelIncrement, WheelMotion, increment_covariance
from monstertruck_kinematics.chassis import Chassis
from monstertruck_kinematics.elementary import Array
from monstertruck_kinematics.se2 import compose, integrate, inverse
from monstertruck_runtime.clock import SECOND
from monstertruck_schemas.sensor import Attitude, DriveFeedback, SteeringFeedback
from monstertruck_schemas.state import ScanMotion

Advance = Callable[[FilterState, Measurement], FilterState]


class MeasurementHistory:
    """Measurements of the last seconds in the order of their stamps, each with the state after it.

    After a late measurement is inserted, ``catch_up`` recomputes those that follow, a bounded number per call.
    Until all are recomputed, ``newest`` continues from the earlier state with every measurement that is in time.

    Args:
        start: initial state.
        advance: function that applies a measurement.
        horizon: time for which measurements are kept (ns).
    """

    def __init__(self, start: FilterState, advance: Advance, horizon: int) -> None:
        self._floor = start
        self._advance = advance
        self._horizon = horizon
        self._rows: list[tuple[Measurement, FilterState]] = []
        self._done = 0
        """Number of leading rows whose states are current."""
        self.newest = start
        """State after all punctual measurements and all late ones recomputed so far."""

    @property
    def waiting(self) -> int:
        """Number of measurements to recompute."""
        return len(self._rows) - self._done

    def reaches(self, stamp: int) -> bool:
        """Whether a measurement of this stamp (ns) can still be inserted."""
        return stamp >= self._floor.stamp

    def scan_before(self, stamp: int) -> int | None:
        """Return the stamp of the last scan not later than ``stamp`` (ns); None without one."""
        for measurement, _ in reversed(self._rows[: self._place(stamp)]):
            if isinstance(measurement, ScanClone | ScanMeasurement):
                return measurement.stamp
        return self._floor.scan

    def insert(self, measurement: Measurement) -> bool:
        """Insert a measurement; return False if it is older than the horizon."""
        if not self.reaches(measurement.stamp):
            return False
        row = self._place(measurement.stamp)
        if row == len(self._rows):
            self.newest = self._advance(self.newest, measurement)
            self._done += not self.waiting
        else:
            self._done = min(self._done, row)
        self._rows.insert(row, (measurement, self.newest))
        self._forget()
        return True

    def rewrite(self, since: int, change: Callable[[Measurement], Measurement]) -> None:
        """Replace the measurements later than ``since`` (ns); they must be recomputed."""
        first = self._place(since)
        self._rows[first:] = [(change(measurement), state) for measurement, state in self._rows[first:]]
        self._done = min(self._done, first)

    def catch_up(self, most: int) -> None:
        """Recompute at most ``most`` measurements, the oldest first."""
        if not self.waiting:
            return
        end = min(self._done + most, len(self._rows))
        state = self._rows[self._done - 1][1] if self._done else self._floor
        for row in range(self._done, end):
            measurement = self._rows[row][0]
            state = self._advance(state, measurement)
            self._rows[row] = (measurement, state)
        self._done = end
        if not self.waiting:
            self.newest = state
            self._forget()

    def _place(self, stamp: int) -> int:
        return bisect_right(self._rows, stamp, key=lambda row: row[0].stamp)

    def _forget(self) -> None:
        oldest = self._rows[-1][0].stamp - self._horizon
        kept = min(bisect_left(self._rows, oldest, key=lambda row: row[0].stamp), self._done)
        if kept:
            self._floor = self._rows[kept - 1][1]
            del self._rows[:kept]
            self._done -= kept


MAX_RECOMPUTED: Final = 6
"""Maximum number of measurements that one estimate recomputes, about a millisecond."""
NAMES: Final = ("drive", "steering", "compass", "imu", "tilt", "lidar")


@dataclass(frozen=True, slots=True)
class FusionStatus:
    """State of the sensors."""

    slipping: bool
    """Whether the wheels slip."""
    doubt: str | None
    """Reason why the compass is rejected; None while it is used."""
    north: float | None
    """Yaw in odom of the compass's zero (rad); None until it is found."""
    trim: float
    """Estimated error of the wheels' curvature (rad/m)."""
    left_out: dict[str, int]
    """Number of readings that could not be used, by sensor and reason."""

    @property
    def disturbed(self) -> bool:
        """Whether the compass is rejected."""
        return self.doubt is not None


class Fusion:
    """Odometry from any subset of wheels, compass and scans; an IMU helps the wheels.

    Args:
        config: noise and limits.
        chassis: maps motors and servos to the body's motion; None without wheels.
        inertial: inertial measurement unit; None if the robot lacks one.
    """

    def __init__(self, config: FusionConfig, chassis: Chassis | None, inertial: Inertial | None = None) -> None:
        self._config = config
        self._inertial = inertial
        self._chassis = chassis
        use = chassis is not None and config.wheels is not None
        self._wheels = WheelMotion(chassis, config.max_speed) if use and chassis is not None else None
        self._slip = SlipDetector(config.slip, 0.0 if config.compass is None else config.compass.local)
        self._turns = HeadingTurns()
        self._history: MeasurementHistory | None = None
        self._last: dict[str, int] = {}
        self._shown: tuple[int, Array] | None = None
        self._correction = SmoothedCorrection(config.slew, math.inf, config.settle)
        self._left_out: Counter[str] = Counter()
        self._changes: deque[SlipChange] = deque()
        self._was_disturbed = False
        self._jump = 0.0
        """Jump of the headings at the onset of the last disturbance (rad); 0 without a jump."""

    # Inputs

    def observe_steering(self, feedback: SteeringFeedback) -> None:
        """Add the commanded servo angles, unless the servo controller marks them untrusted."""
        if self._wheels is not None:
            self._wheels.observe_steering(feedback)

    def observe_drive(self, *shafts: DriveFeedback) -> None:
        """Add the position of every driven shaft."""
        if not shafts or self._wheels is None or self._chassis is None or self._config.wheels is None:
            return
        known, stamp = self._wheels.known, self._wheels.stamp
        roll = self._wheels.observe_drive(*shafts)
        if roll is None:
            if self._wheels.stamp == stamp and known:
                self._left_out["drive: stamp does not increase, or not a finite number"] += 1
            elif self._wheels.known:
                self._begin(self._wheels.stamp)
            return
        if roll.lost:
            self._left_out["drive: position counter restarted"] += 1
            return
        measured = self._felt(roll, self._wheel_measurement(roll, self._chassis))
        self._apply_slip(self._slip.wheels(measured))
        if measured.turn is None and self._slip.slipping:
            self._turns.forget()
        else:
            self._turns.moved(float(measured.delta[2]) if measured.turn is None else measured.turn[0], roll.distance)
        if not self._insert(replace(measured, slipping=self._slip.slipping)):
            self._left_out["drive: too late"] += 1

    def observe_attitude(self, attitude: Attitude) -> None:
        """Add heading and tilt."""
        values = (attitude.heading, attitude.roll, attitude.pitch)
        if not all(map(math.isfinite, values)):
            self._left_out["compass: not a finite number"] += 1
            return
        if not self._later("compass", attitude.stamp):
            return
        if attitude.heading_disturbed:
            self._turns.forget()
        else:
            self._turns.observe(-attitude.heading)
        field = attitude.magnetic_field
        strength = None if field is None else math.hypot(field.x, field.y, field.z)
        heading = HeadingMeasurement(
            stamp=attitude.stamp,
            # The device counts clockwise from north.
            yaw=-attitude.heading,
            disturbed=attitude.heading_disturbed or self._turns.contrary is not None,
            field=strength if strength is not None and math.isfinite(strength) and strength > 0 else None,
            tilt=(attitude.roll, attitude.pitch) if attitude.tilt_valid else None,
        )
        if self._config.compass is None:
            heading = replace(heading, disturbed=True)
        in_time = self._insert(heading)
        if not in_time:
            self._left_out["compass: too late"] += 1
        self._look_for_disturbance()
        if in_time and heading.field is not None and not heading.disturbed and not self._disturbed:
            self._apply_slip(self._slip.heading(attitude.stamp, heading.yaw))
        else:
            self._slip.forget_headings()

    def observe_scan(self, motion: ScanMotion) -> None:
        """Add the motion between two scans, some time after the later scan."""
        if self._config.scans is None:
            return
        measured = _scan_measurement(motion, self._config.scans.scale)
        if measured is None:
            self._left_out["lidar: no motion with a covariance"] += 1
            return
        if not self._later("lidar", measured.stamp):
            return
        dt = (measured.stamp - measured.since) / SECOND
        x, y, yaw = np.abs(measured.delta).tolist()
        margin = (0.1, 0.1)  # allowance for errors of two scans in the limits of their motion, m and rad
        if max(x, y) > self._config.max_speed * dt + margin[0] or yaw > self._config.max_turn * dt + margin[1]:
            self._left_out["lidar: motion faster than the robot's maximum"] += 1
            return
        self._apply_slip(self._slip.scans(measured))
        if self._slip.doubted:
            self._left_out["lidar: contradicts the wheels right after a gap"] += 1
            return
        history = self._begin(measured.since)
        if history.scan_before(measured.stamp) != measured.since:
            # The clone of the earlier pose must be inserted at its own stamp.
            self._insert(ScanClone(measured.since, measured.covariance))
        if not self._insert(measured):
            self._left_out["lidar: too late"] += 1

    # Outputs

    def changes(self) -> list[SlipChange]:
        """Return the onsets and ends of slip since the last call."""
        changes = list(self._changes)
        self._changes.clear()
        return changes

    def status(self) -> FusionStatus:
        """Return the state of the sensors."""
        state = None if self._history is None else self._history.newest
        gate = None if state is None else state.gate
        return FusionStatus(
            slipping=self._slip.slipping,
            doubt=self._doubt if gate is not None and gate.disturbed else None,
            north=None if state is None or not state.gate.anchored else float(state.mean[6]),
            trim=0.0 if state is None else float(state.mean[TRIM]),
            left_out=dict(self._left_out),
        )

    @property
    def _doubt(self) -> str:
        contrary = self._turns.contrary
        if contrary is not None:
            return contrary.text
        if self._jump:
            return f"its headings jumped by {self._jump:+.2f} rad although the robot did not turn"
        return "its headings or its field strength are wrong"

    @property
    def state(self) -> FilterState | None:
        """State of the filter at its latest measurement."""
        return None if self._history is None else self._history.newest

    @property
    def waiting(self) -> int:
        """Number of measurements to recompute: late ones, and those after them."""
        return 0 if self._history is None else self._history.waiting

    def sources(self, now: int) -> tuple[str, ...]:
        """Return the sensors used in the last second, at ``now`` (ns)."""
        used = {} if self._history is None else dict(self._history.newest.used)
        if self._wheels is not None and self._wheels.steered is not None and "drive" in used:
            used["steering"] = self._wheels.steered
        return tuple(name for name in NAMES if name in used and now - used[name] <= SOURCE_TIMEOUT)

    def estimate(self, now: int) -> OdometryEstimate | None:
        """Return the pose at ``now`` (ns), continuous over corrections; None before the first reading.

        Every call recomputes at most ``MAX_RECOMPUTED`` measurements.
        """
        if self._history is None:
            return None
        self._history.catch_up(MAX_RECOMPUTED)
        self._look_for_disturbance()
        state, config = self._history.newest, self._config
        moved = max((state.used[name] for name in MOVED_BY if name in state.used), default=state.stamp)
        last = max(moved, state.stamp)
        ahead = predict(state, min(now, last + round(config.max_prediction * SECOND)), config)
        grown = predict(state, now, config).covariance
        pose = self._continuous(ahead, now)
        off = pose - ahead.mean[POSE]
        off[2] = math.remainder(off[2], math.tau)
        vx, vy, wz = ahead.mean[TWIST].tolist()
        return OdometryEstimate(
            pose=(float(pose[0]), float(pose[1]), math.remainder(float(pose[2]), math.tau)),
            twist=(vx, vy, wz),
            pose_covariance=(grown[POSE, POSE] + np.outer(off, off)).ravel(),
            twist_covariance=grown[TWIST, TWIST].ravel(),
            age=max((now - moved) / SECOND, 0.0),
            sources=self.sources(now),
        )

    def _continuous(self, ahead: FilterState, now: int) -> Array:
        """Return the published pose: integrated from the twist, corrected to the state at a limited rate."""
        target = ahead.mean[POSE].copy()
        if self._shown is None:
            self._shown = (now, target)
            self._correction.set_target((0.0, 0.0, 0.0), at_once=True)
            return target
        then, carried = self._shown
        dt = max((now - then) / SECOND, 0.0)
        x, y, yaw = carried.tolist()
        vx, vy, wz = ahead.mean[TWIST].tolist()
        carried = np.array(integrate((x, y, yaw), vx, vy, wz, dt))
        self._shown = (max(now, then), carried)
        x, y, yaw = compose(target, inverse(carried)).tolist()
        self._correction.set_target((x, y, yaw))
        return np.array(self._correction.pose((carried[0], carried[1], carried[2]), dt))

    # Order

    def _begin(self, stamp: int) -> MeasurementHistory:
        if self._history is None:
            advance = partial(apply_measurement, config=self._config)
            self._history = MeasurementHistory(
                initial_state(stamp, self._config), advance, round(self._config.horizon * SECOND)
            )
        return self._history

    def _insert(self, measurement: Measurement) -> bool:
        stamp = measurement.since if isinstance(measurement, WheelMeasurement | ScanMeasurement) else measurement.stamp
        return self._begin(stamp).insert(measurement)

    def _later(self, sensor: str, stamp: int) -> bool:
        if stamp <= self._last.get(sensor, -1):
            self._left_out[f"{sensor}: stamp does not increase"] += 1
            return False
        self._last[sensor] = stamp
        return True

    @property
    def _disturbed(self) -> bool:
        return self._history is not None and self._history.newest.gate.disturbed

    def _look_for_disturbance(self) -> None:
        """Withdraw the headings shortly before a detected disturbance: a magnet acts before its detection."""
        if self._disturbed and not self._was_disturbed and self._history is not None:
            gate = self._history.newest.gate
            self._jump = gate.jump
            self._history.rewrite(0, partial(_taken_back, jump=gate.jump, at=gate.steady_since))
            self._slip.forget_headings()
        self._was_disturbed = self._disturbed

    def _apply_slip(self, change: SlipChange | None) -> None:
        if change is None:
            return
        self._changes.append(change)
        if change.slipping and self._history is not None:
            self._history.rewrite(change.since, _slipping)
        if change.slipping and self._inertial is not None:
            self._inertial.gyro.wheels_slipped(change.since)

    def _wheel_measurement(self, roll: WheelIncrement, chassis: Chassis) -> WheelMeasurement:
        assert self._config.wheels is not None
        trust = self._config.wheels
        delta = np.array(integrate((0.0, 0.0, 0.0), *roll.twist, roll.dt))
        noise = increment_covariance(chassis, roll, trust.shaft_noise, trust.angle_noise, trust.slip_noise)
        return WheelMeasurement(roll.since, roll.stamp, delta, noise)

    def _felt(self, roll: WheelIncrement, measured: WheelMeasurement) -> WheelMeasurement:
        """Return the motion of the wheels with turn and tilt by the IMU."""
        inertial, trust = self._inertial, self._config.imu
        if inertial is None or trust is None:
            return measured
        wheels = None if self._slip.slipping else roll.twist[2]
        trusted = inertial.gyro.trusted
        rate = inertial.gyro.turned(roll.since, roll.stamp, wheels, roll.distance)
        if trusted and not inertial.gyro.trusted and self._history is not None:
            crept = inertial.gyro.bias is None
            seconds = self._config.horizon if crept else trust.window
            self._history.rewrite(roll.since - round(seconds * SECOND), _without_turn)
        turn = None if rate is None else rate * roll.dt
        variance = 0.0
        if turn is not None:
            drifted = inertial.gyro.variance(roll.stamp, roll.dt, roll.distance)
            variance = trust.noise**2 * roll.dt + (trust.scale * turn) ** 2 + drifted
        return replace(
            measured, turn=None if turn is None else (turn, variance), tilt=inertial.vertical.tilt(roll.stamp)
        )


def _slipping(measurement: Measurement) -> Measurement:
    return replace(measurement, slipping=True) if isinstance(measurement, WheelMeasurement) else measurement


def _without_turn(measurement: Measurement) -> Measurement:
    return replace(measurement, turn=None) if isinstance(measurement, WheelMeasurement) else measurement


def _taken_back(measurement: Measurement, jump: float, at: int) -> Measurement:
    """Mark a heading before the disturbance that began ``at`` (ns) with a ``jump`` (rad) as rejected."""
    if not isinstance(measurement, HeadingMeasurement):
        return measurement
    return replace(measurement, taken_back=True, jump=jump if measurement.stamp == at else measurement.jump)


def _scan_measurement(motion: ScanMotion, scale: float) -> ScanMeasurement | None:
    delta = np.array((motion.motion.x, motion.motion.y, motion.motion.yaw))
    covariance = np.array(motion.covariance).reshape(3, 3) * scale**2
    covariance = (covariance + covariance.T) / 2
    if motion.since >= motion.stamp or not (np.isfinite(delta).all() and np.isfinite(covariance).all()):
        return None
    if float(np.linalg.eigvalsh(covariance)[0]) <= 0.0:
        return None
    return ScanMeasurement(motion.since, motion.stamp, delta, covariance)
