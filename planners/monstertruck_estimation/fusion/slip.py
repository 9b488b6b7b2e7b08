"""Wheel slip detection: compares the wheels' motion with the motion between scans, or their yaw with the compass.

Scans are evidence against the wheels only while they are matched without a gap. After a gap, or after an unconstrained
direction, the matched surfaces may move along with the robot (the ground ahead on a slope). The scans must then agree
with the wheels for a while first; until they do, the scans are rejected.
"""

import math
from collections import deque
from dataclasses import dataclass
from typing import Final

import numpy as np

from monstertruck_estimation.fusion.config import DEVIATION_SCALE, SlipConfig
from monstertruck_estimation.fusion.filter import ScanMeasurement, WheelMeasurement
from monstertruck_estimation.transforms import wrap_angle
from monstertruck_kinematics.elementary import Array
from monstertruck_kinematics.se2 import between, compose, compose_jacobians, interpolate
from monstertruck_runtime.clock import SECOND

BLIND: Final = SECOND
"""Maximum time without scans (ns); then the wheels are compared with the compass."""
SPAN: Final = SECOND
"""Time over which wheels and compass are compared (ns)."""


@dataclass(frozen=True, slots=True)
class SlipChange:
    """Start or end of wheel slip."""

    slipping: bool
    since: int
    """Start of the slip (ns); from then on the wheels are not trusted."""
    text: str
    """Description of the disagreement."""


class SlipDetector:
    """Compare wheels with scans or compass, with hysteresis.

    Args:
        config: thresholds.
        deviation: standard deviation of the compass's local deviation (rad).
    """

    def __init__(self, config: SlipConfig, deviation: float) -> None:
        self._config = config
        self._deviation = deviation
        self._trail: deque[tuple[int, Array, Array]] = deque()
        """Stamp, pose, and sum of the motions' covariances; their rotation is negligible in so short a window."""
        self._motions: deque[ScanMeasurement] = deque()
        self._headings: deque[tuple[int, float]] = deque()
        self._suspicious = 0
        self._calm = 0
        self._scanned: int | None = None
        self._compared_at = 0
        """Stamp of the last comparison (ns)."""
        self._unproven = 0
        """Number of scans that must agree with the wheels before scans are used."""
        self.slipping = False
        self.doubted = False
        """Whether the last scan is rejected."""

    def wheels(self, measured: WheelMeasurement) -> SlipChange | None:
        """Add a motion of the wheels; return the end of a slip that no sensor can confirm any longer."""
        if not self._trail or self._trail[-1][0] != measured.since:
            self._trail.clear()
            self._trail.append((measured.since, np.zeros(3), np.zeros((3, 3))))
        _, pose, spread = self._trail[-1]
        self._trail.append((measured.stamp, compose(pose, measured.delta), spread + measured.covariance))
        while self._trail[0][0] < measured.stamp - 3 * SECOND:  # time for which wheel motion is stored, ns
            self._trail.popleft()
        # Maximum age of the last confirmation of slip, ns: then the scans have ended, and only the wheels are left.
        expires = 10 * SECOND
        if not self.slipping or measured.stamp - self._compared_at < expires:
            return None
        self.slipping = False
        text = f"no other motion measurement for {expires // SECOND} s: the wheels are used again"
        return SlipChange(slipping=False, since=measured.stamp, text=text)

    def scans(self, measured: ScanMeasurement) -> SlipChange | None:
        """Add the motion between two scans; return a change of the result."""
        self._scanned, self.doubted = measured.stamp, False
        if self._motions and self._motions[-1].stamp != measured.since:
            self._motions.clear()
            self._unproven = self._config.calm
        # 1.0: minimum standard deviation of a scan in an unconstrained direction, m
        if float(np.linalg.eigvalsh(measured.covariance[:2, :2])[-1]) > 1.0**2:
            self._unproven = self._config.calm
        self._motions.append(measured)
        # 2: number of windows over which wheels and scans are also compared
        while len(self._motions) > 1 and measured.stamp - self._motions[1].since >= 2 * self._window:
            self._motions.popleft()
        recent = sum(1 for one in self._motions if measured.stamp - one.stamp < self._window)
        near = self._compared(recent)
        if near is None:
            return None
        self._compared_at = measured.stamp
        if self._unproven and not self.slipping:
            self._prove(near[0])
            return None
        # Slip adds up, noise averages out: a doubtful difference over one window is clear over two.
        far = None if self.slipping else self._compared(len(self._motions))
        change = self._judged(*(near if far is None or far[0] < near[0] else far))
        if change is not None and not change.slipping:
            self._agreed()
        return change

    @property
    def _window(self) -> int:
        return round(self._config.window * SECOND)

    def _agreed(self) -> None:
        """Drop older windows."""
        while len(self._motions) > 1:
            self._motions.popleft()

    def _compared(self, count: int) -> tuple[float, int, str] | None:
        """Compare the wheels with the last ``count`` motions; return deviation, start (ns) and description."""
        motions = list(self._motions)[-count:]
        since, stamp = motions[0].since, motions[-1].stamp
        wheels_moved = self._wheel_motion(since, stamp)
        if wheels_moved is None:
            return None
        moved = np.zeros(3)
        for one in motions:
            moved = compose(moved, one.delta)
        _, by_later = compose_jacobians(moved, np.zeros(3))
        # Only the errors of the first and the last place remain: the errors in between cancel.
        spread = motions[0].covariance + by_later @ motions[-1].covariance @ by_later.T
        delta, noise = wheels_moved
        off = delta - moved
        off[2] = wrap_angle(float(off[2]))
        distance = math.sqrt(float(off @ np.linalg.solve(spread + noise, off)))
        seconds = (stamp - since) / SECOND
        text = f"wheels and scans differ by {math.hypot(off[0], off[1]):.3f} m and {off[2]:+.3f} rad in {seconds:.1f} s"
        return distance, since, text

    def heading(self, stamp: int, yaw: float) -> SlipChange | None:
        """Add an undisturbed heading (counter-clockwise, rad), used if there are no scans."""
        jitter = 0.01  # standard deviation of a compass heading against the one a second before, rad
        if self._headings:
            last, before = self._headings[-1]
            # 3.0: maximum turn rate of a robot, rad/s
            if abs(wrap_angle(yaw - before)) > jitter * 4 + 3.0 * (stamp - last) / SECOND:
                # The field has changed: no robot turns so fast.
                self._headings.clear()
        self._headings.append((stamp, yaw))
        while len(self._headings) > 1 and stamp - self._headings[1][0] >= SPAN:
            self._headings.popleft()
        since, before = self._headings[0]
        if self._scanned is not None and stamp - self._scanned < BLIND:
            return None
        wheels_moved = self._wheel_motion(since, stamp) if stamp - since >= SPAN * 3 // 4 else None
        if wheels_moved is None:
            return None
        delta, noise = wheels_moved
        off = wrap_angle(float(delta[2]) - wrap_angle(yaw - before))
        like = math.exp(
            -math.hypot(delta[0], delta[1]) / DEVIATION_SCALE[0] - abs(float(delta[2])) / DEVIATION_SCALE[1]
        )
        elsewhere = jitter**2 + self._deviation**2 * (1 - like)
        distance = abs(off) / math.sqrt(float(noise[2, 2]) + 2 * elsewhere)
        self._compared_at = stamp
        text = f"wheels and compass differ by {off:+.3f} rad in {(stamp - since) / SECOND:.1f} s"
        return self._judged(distance, since, text)

    def forget_headings(self) -> None:
        """Forget the headings before a disturbance of the compass."""
        self._headings.clear()

    def _wheel_motion(self, since: int, stamp: int) -> tuple[Array, Array] | None:
        """Return the motion of the wheels between two instants and its covariance, (3,) and (3, 3); None if unknown."""
        trail = self._trail
        # (SECOND // 8): maximum lead of a scan over the wheels, ns; the wheels' velocity is extrapolated
        if len(trail) < 2 or since < trail[0][0] or stamp > trail[-1][0] + (SECOND // 8):
            return None
        stamps = np.array([row[0] - since for row in trail], dtype=np.float64)
        poses = np.array([row[1] for row in trail])
        if stamp > trail[-1][0]:
            share = (stamp - trail[-1][0]) / (trail[-1][0] - trail[-2][0])
            further = compose(poses[-1], between(poses[-2], poses[-1]) * share)
            stamps, poses = np.append(stamps, stamp - since), np.vstack((poses, further))
        begin, end = interpolate(stamps, poses, np.array((0.0, stamp - since), dtype=np.float64))
        delta = between(begin, end)
        first, last = np.searchsorted(stamps[: len(trail)], (0, stamp - since))
        grown = trail[min(int(last), len(trail) - 1)][2] - trail[max(int(first) - 1, 0)][2]
        place, turn = max(grown[0, 0], grown[1, 1], 0.0), max(grown[2, 2], 0.0)
        speed, rate = (abs(delta) / ((stamp - since) / SECOND))[[0, 2]]
        timing = self._config.timing
        floor = (0.003, 0.005)  # standard deviation of any comparison, m and rad
        return delta, np.diag(
            (
                place + floor[0] ** 2 + (timing * speed) ** 2,
                place + floor[0] ** 2 + (timing * speed) ** 2,
                turn + floor[1] ** 2 + (timing * rate) ** 2,
            )
        )

    def _prove(self, distance: float) -> None:
        self.doubted = distance > self._config.gate
        if distance < self._config.release:
            self._unproven -= 1
            if not self._unproven:
                self._agreed()
        elif self.doubted:
            self._unproven = self._config.calm

    def _judged(self, distance: float, since: int, text: str) -> SlipChange | None:
        config = self._config
        if not self.slipping:
            self._suspicious = self._suspicious + 1 if distance > config.gate else 0
            if self._suspicious >= 2 or distance > 2 * config.gate:
                self.slipping, self._suspicious, self._calm = True, 0, 0
                return SlipChange(slipping=True, since=since, text=text)
            return None
        self._calm = self._calm + 1 if distance < config.release else 0
        if self._calm < config.calm:
            return None
        self.slipping = False
        return SlipChange(slipping=False, since=since, text=text)
