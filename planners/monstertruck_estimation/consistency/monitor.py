"""Pure core of the consistency check: takes the sensors' readings and finds those that cannot be right.

The monitor compares motions at every scan, over windows from half a second to some seconds; without a lidar, at every
wheel reading. A difference must last for two comparisons. If one of the compared motions is the scans', they must
refute the other: see ``ScanVerdict``. A finding about motion lasts until the robot is armed again, because a standing
robot provides no evidence. A finding about a repeated value ends with the repetition, one about a changed scale when
the scale has changed back.
"""

import math
from collections import deque
from collections.abc import Collection, Iterator
from typing import Final, NamedTuple

from monstertruck_estimation.consistency.comparison import (
    MOST_DEVIATIONS,
    Disagreement,
    Measure,
    Motions,
    differences,
    errors_of,
    suspects,
    turn_difference,
    way_limit,
)
from monstertruck_estimation.consistency.config import ConsistencyConfig
from monstertruck_estimation.consistency.delay import Delay, LagQuestion, ScanStep, lag_question
from monstertruck_estimation.consistency.exchange import IN_USE, Claim, StepOutput
from monstertruck_estimation.consistency.repeats import RepeatDetector, WholeRepeats
from monstertruck_estimation.consistency.rest import RestWatch
from monstertruck_estimation.consistency.tracks import STILL, MotionTrack, between
from monstertruck_estimation.transforms import wrap_angle
from monstertruck_estimation.wheel_motion import WheelIncrement
from monstertruck_kinematics.se2 import Pose2
from monstertruck_runtime.clock import SECOND
from monstertruck_schemas.base import Pose2D
from monstertruck_schemas.state import Doubt, DoubtKind, StandingBody, UnshownMotion

WINDOWS: Final = (0.5, 0.75, 1.0, 1.5, 2.0, 3.0, 5.0, 8.0)
"""Windows over which motions are compared, up to the configured one (s)."""
WITNESSES: Final = (Measure.WHEELS, Measure.GYRO, Measure.ENCODERS, Measure.STAND)
"""Measures that reveal when the motion changes."""
GAP: Final = SECOND // 2
"""Maximum time between joined headings or rates (ns)."""


class _OpenDisagreement(NamedTuple):
    """Difference that the scans must judge."""

    since: int
    found: dict[Measure, Disagreement]
    claimant: Measure
    errors: tuple[float, float]
    """Errors that the claimant states over the window (m, rad)."""


class ConsistencyMonitor:
    """Consistency monitor of one robot's measures.

    Args:
        config: tolerances.
        sensors: sensor of each of the robot's measures.
    """

    def __init__(self, config: ConsistencyConfig, sensors: dict[Measure, str]) -> None:
        self._config, self._sensors = config, sensors
        self._errors = errors_of(config)
        self._tracks = {measure: MotionTrack() for measure in sensors}
        self._witnesses = [measure for measure in WITNESSES if measure in sensors]
        self._sampled: dict[Measure, int] = {}
        self._seen: tuple[int, Pose2] | None = None
        """Stamp (ns) and pose from the latest sample of the stand's cameras."""
        self._heading: tuple[int, float] | None = None
        self._rate: tuple[int, float] | None = None
        self._bias: float | None = None
        self._rest: list[float] = []
        self._rest_since: int | None = None
        self._scans: deque[int] = deque(maxlen=256)
        """Stamps of scans with known motion."""
        self._intervals: deque[float] = deque([0.0], maxlen=10)  # the longest of these
        """Intervals between the latest scans (s)."""
        self._steps: deque[ScanStep] = deque()
        self._scatter = 0.0, 0.0
        """Scatter of the latest motions by scans (m, rad)."""
        self._delayed_at = 0
        self._active_since: int | None = None
        self._doubted: frozenset[Measure] = frozenset()
        """Measures in doubt at the previous comparison."""
        self._resting: RestWatch | None = None
        if {Measure.WHEELS, Measure.SCANS} <= sensors.keys():
            self._resting = RestWatch(self._tracks[Measure.WHEELS], config.slip)
        self.standing: StandingBody | None = None
        """Evidence by the latest scan that the body stands although its wheels roll; None without."""
        self._pending: _OpenDisagreement | None = None
        self._asked = 0
        self._found: dict[str, Doubt] = {}
        self._scale = 1.0
        """Factor from the lidar's first ranges to the current ones."""
        self._scaled: Doubt | None = None
        self._values: dict[str, dict[str, RepeatDetector]] = {}
        self._wholes: dict[str, WholeRepeats] = {}
        self._whole_moved: dict[str, int] = {}
        self._frozen: dict[str, Doubt] = {}

    # Readings of the sensors

    def observe_wheels(self, roll: WheelIncrement) -> None:
        """Take the motion of the wheels between two readings."""
        self._sampled[Measure.WHEELS] = roll.stamp
        track = self._tracks[Measure.WHEELS]
        if roll.lost:
            track.begin(roll.stamp)
            return
        vx, vy, wz = roll.twist
        turn = wz * roll.dt
        c, s = math.cos(turn / 2), math.sin(turn / 2)
        track.add(roll.stamp, ((c * vx - s * vy) * roll.dt, (s * vx + c * vy) * roll.dt, turn))
        if Measure.SCANS not in self._sensors:
            self._compare(roll.stamp)

    def observe_encoders(self, stamp: int, motion: Pose2) -> None:
        """Take the motion of free wheels since their previous reading (m, rad); ``stamp`` in ns."""
        self._sampled[Measure.ENCODERS] = stamp
        self._tracks[Measure.ENCODERS].add(stamp, motion)

    def observe_stand(self, stamp: int, pose: Pose2D) -> None:
        """Take the robot's pose from the overhead cameras; ``stamp`` in ns."""
        seen = pose.x, pose.y, pose.yaw
        before, self._seen = self._seen, (stamp, seen)
        self._sampled[Measure.STAND] = stamp
        track = self._tracks[Measure.STAND]
        if before is None or not 0 < stamp - before[0] <= GAP:
            track.begin(stamp)
        else:
            x, y, turn = between(before[1], seen)
            track.add(stamp, (x, y, float(wrap_angle(turn))))

    def observe_heading(self, stamp: int, yaw: float | None) -> None:
        """Take a counter-clockwise heading (rad); None if the compass reports a disturbance."""
        before, self._heading = self._heading, None if yaw is None else (stamp, yaw)
        self._sampled[Measure.COMPASS] = stamp
        track = self._tracks[Measure.COMPASS]
        if yaw is None or before is None or not 0 < stamp - before[0] <= GAP:
            track.begin(stamp)
        else:
            track.add(stamp, (0.0, 0.0, float(wrap_angle(yaw - before[1]))))

    def observe_rate(self, stamp: int, rate: float) -> None:
        """Take a yaw rate (rad/s); its bias is learned while the wheels stand."""
        before, self._rate = self._rate, (stamp, rate)
        self._sampled[Measure.GYRO] = stamp
        self._learn_bias(stamp, rate)
        track = self._tracks[Measure.GYRO]
        if self._bias is None or before is None or not 0 < stamp - before[0] <= GAP:
            track.begin(stamp)
        else:
            turn = (rate + before[1]) / 2 - self._bias
            track.add(stamp, (0.0, 0.0, turn * (stamp - before[0]) / SECOND))

    def observe_scan(self, output: StepOutput) -> None:
        """Take the motion between two scans and the scans' verdict on a claim."""
        before = self._sampled.get(Measure.SCANS, output.stamp)
        self._intervals.append((output.stamp - before) / SECOND)
        self._sampled[Measure.SCANS] = output.stamp
        if output.scale is not None:
            self._take_scale(output.stamp, output.scale)
        elif output.stamp - before > IN_USE:
            self._scale, self._scaled = 1.0, None  # a lidar that was restarted
        track = self._tracks[Measure.SCANS]
        if output.since is None:
            track.begin(output.stamp)
            self._scans.clear()
            self._steps.clear()
            self._pending, self._doubted = None, frozenset()
        else:
            track.add(output.stamp, output.motion)
            moved = output.motion[0], output.motion[2]
            self._scatter = output.scatter
            self._steps.append(ScanStep(output.since, output.stamp, moved, output.errors))
            delay_over = 4 * SECOND  # time over which the delay is determined, ns
            while output.stamp - self._steps[0].since > delay_over:
                self._steps.popleft()
        self._scans.append(output.stamp)
        self.standing = output.stands
        if self._resting is not None:
            self._resting.observe(output)
        if output.verdict is not None and self._pending is not None:
            if output.verdict.refuted:
                self._accuse(output.stamp, self._pending.found)
            self._pending = None
        if output.delay is not None and self._active_since is not None:
            self._take_delay(output.stamp, output.delay)
        self._compare(output.stamp)

    def observe_value(self, sensor: str, field: str, stamp: int, value: float) -> None:
        """Take a number measured by a sensor; ``stamp`` in ns."""
        repeats = self._values.setdefault(sensor, {}).setdefault(field, RepeatDetector())
        repeats.observe(value, still=self.still(stamp))
        self._note_frozen(sensor, field, stamp, repeats.row, frozen=repeats.frozen)

    def observe_whole(self, sensor: str, stamp: int, whole: bytes | None) -> None:
        """Add a whole scan or image as bytes; None if it has too little content for a comparison."""
        repeats = self._wholes.setdefault(sensor, WholeRepeats())
        before, self._whole_moved[sensor] = self._whole_moved.get(sensor, stamp), stamp
        if whole is None:
            repeats.pause()
        else:
            repeats.observe(whole, moved=self._moved(before, stamp))
        self._note_frozen(sensor, "content", stamp, repeats.row, frozen=repeats.frozen)

    # Conclusions

    def activate(self, now: int | None) -> None:
        """Drop the findings about motion when the robot is armed at ``now`` (ns); None stops the comparisons."""
        self._active_since = now
        self._pending, self._doubted = None, frozenset()
        self._steps.clear()
        if now is not None:
            self._found.clear()

    def claim(self, stamp: int) -> Claim | None:
        """Return the motion up to the next scan, at ``stamp`` (ns), that the scans must judge."""
        pending = self._pending
        if pending is None:
            return None
        motion = self._tracks[pending.claimant].motion(pending.since, stamp)
        if motion is None:
            self._pending = None
            return None
        ways = self._errors[pending.claimant].way is not None
        return Claim(pending.since, motion[:2] if ways else None, motion[2], pending.errors)

    def rolled(self, stamp: int) -> Pose2 | None:
        """Return the motion by the wheels from the latest scan to the next one, at ``stamp`` (ns)."""
        track, before = self._tracks.get(Measure.WHEELS), self._sampled.get(Measure.SCANS)
        return None if track is None or before is None else track.motion(before, stamp)

    def rest_claim(self, stamp: int, end: int) -> Claim | None:
        """Return the claim that the robot stands like its wheels up to the next scan, from first to last beam (ns)."""
        return None if self._resting is None else self._resting.claim(stamp, end)

    @property
    def unshown(self) -> UnshownMotion | None:
        """Motion of the body that its wheels do not show, at the latest scan."""
        return None if self._resting is None else self._resting.motion

    def findings(self) -> tuple[Doubt, ...]:
        """Return the current findings."""
        scaled = () if self._scaled is None else (self._scaled,)
        return (*self._found.values(), *scaled, *self._frozen.values())

    def in_use(self, now: int) -> tuple[Measure, ...]:
        """Return the measures with recent samples."""
        return tuple(one for one in self._sensors if now - self._sampled.get(one, -IN_USE) < IN_USE)

    def measures_way(self, measure: Measure) -> bool:
        """Whether a measure includes distance."""
        return self._errors[measure].way is not None

    def still(self, stamp: int) -> bool:
        """Whether the wheels stood shortly before ``stamp`` (ns)."""
        track = self._tracks.get(Measure.WHEELS)
        if track is None or track.newest is None:
            return False
        speed, rate = track.pace(min(stamp, track.newest))
        return speed < STILL[0] and rate < STILL[1]

    def _moved(self, since: int, stamp: int) -> float:
        """Return the larger of distance (m) and turn (rad) by the wheels; 0 while they stand."""
        track = self._tracks.get(Measure.WHEELS)
        if track is None or track.newest is None or self.still(stamp):
            return 0.0
        motion = track.motion(since, min(stamp, track.newest))
        return 0.0 if motion is None else max(math.hypot(motion[0], motion[1]), abs(motion[2]))

    def _learn_bias(self, stamp: int, rate: float) -> None:
        if not self.still(stamp):
            self._rest, self._rest_since = [], None
            return
        self._rest_since = stamp if self._rest_since is None else self._rest_since
        self._rest.append(rate)
        rest = SECOND // 2  # minimum time at rest to measure the bias of a gyroscope, ns
        if stamp - self._rest_since >= rest:
            mean = math.fsum(self._rest) / len(self._rest)
            self._bias = mean if abs(mean) <= 0.1 else self._bias  # maximum bias, rad/s: a higher mean rate is a turn
            self._rest, self._rest_since = [], None

    def _compare(self, stamp: int) -> None:
        """Compare all measures over all windows that end at ``stamp`` (ns)."""
        if self._active_since is None:
            return
        worst: dict[Measure, Disagreement] = {}
        begun, errors = stamp, (0.0, 0.0)
        for since in self._starts(stamp):
            motions = {m: motion for m, track in self._tracks.items() if (motion := track.motion(since, stamp))}
            if len(motions) < 2:
                continue
            window = Motions(since, stamp, motions, self._slack(motions, since, stamp))
            for measure, found in suspects(*differences(window, self._errors)).items():
                if measure not in worst:
                    worst[measure], begun = found, since
                    errors = self._tolerated(window, found)
        before, self._doubted = self._doubted, frozenset(worst)
        lasting = {measure: found for measure, found in worst.items() if measure in before}
        if not lasting:
            return
        claimant = _claimant(lasting)
        again = SECOND // 5  # minimum time between two claims that the scans judge, ns
        if claimant is None:
            self._accuse(stamp, lasting)
        elif self._pending is None and stamp - self._asked >= again:
            self._pending, self._asked = _OpenDisagreement(begun, lasting, claimant, errors), stamp

    def _slack(self, motions: Collection[Measure], since: int, stamp: int) -> tuple[float, float]:
        """Return the difference that delays and stamp errors explain (m, rad).

        A constant delay costs the change of the speed; a stamp error costs the distance travelled meanwhile. Stamps
        of sparse scans, or of scans in bursts, are as uncertain as the interval between them. Scans whose motions
        scatter more than they state are that uncertain.
        """
        interval, delay = max(self._intervals), self._config.delay
        error = interval if interval > delay else 0.05  # error of a stamp, s
        paces = [(self._tracks[measure].pace(since), self._tracks[measure].pace(stamp)) for measure in motions]
        way, turn = (
            max(delay * abs(end[axis] - begin[axis]) + error * max(begin[axis], end[axis]) for begin, end in paces)
            for axis in (0, 1)
        )
        if Measure.SCANS not in motions:
            return way, turn
        # Among people who walk with the robot, the registration jumps from one person to the next.
        errors, scatter = self._errors[Measure.SCANS], [MOST_DEVIATIONS * math.sqrt(2.0) * one for one in self._scatter]
        stated = 0.0 if errors.way is None else errors.way[1]
        return way + max(0.0, scatter[0] - stated), turn + max(0.0, scatter[1] - errors.turn[1])

    def _tolerated(self, window: Motions, found: Disagreement) -> tuple[float, float]:
        """Return the maximum difference of the true motion from the claimed one (m, rad)."""
        claimant = _claimant({found.one: found})
        if claimant is None:
            return 0.0, 0.0
        pair = Measure.SCANS, claimant
        _, turn = turn_difference(window, *pair, self._errors)
        if self._errors[claimant].way is None:
            return 0.15, turn  # maximum change of the distance with a claimed turn, m
        return way_limit(window, *pair, self._errors), turn

    def _starts(self, stamp: int) -> Iterator[int]:
        """Yield the starts of the windows that end at ``stamp`` (ns): at scans, if there are any."""
        assert self._active_since is not None
        windows = [round(window * SECOND) for window in WINDOWS if window <= self._config.window]
        if Measure.SCANS not in self._sensors:
            yield from (stamp - window for window in windows if stamp - window >= self._active_since)
            return
        scans, at = list(self._scans), len(self._scans) - 1
        for window in windows:
            while at > 0 and stamp - scans[at] < window:
                at -= 1
            if at < 0 or stamp - scans[at] < window or scans[at] < self._active_since:
                return
            yield scans[at]

    def lag(self) -> LagQuestion | None:
        """Return the latest motion by scans and the earlier one by other measures, to find the lag of the scans."""
        if not self._steps or self._active_since is None:
            return None
        delay_period = SECOND // 4  # time between two checks of the scans' delay, ns
        if self._steps[-1].stamp - self._delayed_at < delay_period:
            return None
        self._delayed_at = self._steps[-1].stamp
        steps = [step for step in self._steps if step.since >= self._active_since]
        interval, tolerated = max(self._intervals), self._config.delay
        tolerated += interval if interval > tolerated else 0.0  # their stamps are as uncertain as that
        others = [(self._errors[measure], self._tracks[measure]) for measure in self._witnesses]
        question = lag_question(steps, others, tolerated)
        return question if question.others else None

    def _take_delay(self, stamp: int, delay: Delay) -> None:
        lidar, (first, *_) = self._sensors[Measure.SCANS], self._witnesses
        text = (
            f"motion in the scans lags {delay.seconds:.1f} s behind the "
            f"{' and the '.join(self._witnesses)}: limit {self._config.delay:g} s"
        )
        self._found.setdefault(
            lidar,
            Doubt(
                sensor=lidar,
                kind=DoubtKind.DELAY,
                since=stamp,
                text=text,
                against=self._sensors[first],
                difference=delay.seconds,
                limit=self._config.delay,
            ),
        )

    def _take_scale(self, stamp: int, factor: float) -> None:
        """Note a change of all ranges by one factor; it ends when the ranges have changed back."""
        errors = self._errors[Measure.SCANS].way
        tolerated = 0.0 if errors is None else errors[0]
        self._scale *= factor
        self._scaled = None
        if abs(self._scale - 1.0) > tolerated:
            text = (
                f"its ranges became {self._scale:.2f} times as long from one revolution to the next; "
                f"check one with a tape, then switch the lidar off for more than {IN_USE / SECOND:g} s to "
                "accept them"
            )
            self._scaled = Doubt(
                sensor=self._sensors[Measure.SCANS],
                kind=DoubtKind.SCALE,
                since=stamp,
                text=text,
                difference=abs(self._scale - 1.0),
                limit=tolerated,
            )

    def _accuse(self, stamp: int, found: dict[Measure, Disagreement]) -> None:
        for measure, difference in found.items():
            other = difference.other if measure is difference.one else difference.one
            sensor = self._sensors[measure]
            self._found.setdefault(
                sensor,
                Doubt(
                    sensor=sensor,
                    kind=DoubtKind.MOTION,
                    since=stamp,
                    text=difference.text,
                    against=self._sensors[other],
                    difference=difference.difference,
                    limit=difference.limit,
                ),
            )

    def _note_frozen(self, sensor: str, field: str, stamp: int, row: int, *, frozen: bool) -> None:
        known = self._frozen.get(sensor)
        if frozen and known is None:
            text = f"its {field} is identical {row} times in a row"
            self._frozen[sensor] = Doubt(
                sensor=sensor, kind=DoubtKind.REPEATS, since=stamp, text=text, difference=float(row), limit=1.0
            )
        elif known is not None and not any(one.frozen for one in self._values.get(sensor, {}).values()) and not frozen:
            del self._frozen[sensor]


def _claimant(found: dict[Measure, Disagreement]) -> Measure | None:
    """Return the measure whose motion the scans must judge; None if the scans agree with every measure."""
    for difference in found.values():
        if Measure.SCANS in (difference.one, difference.other):
            return difference.other if difference.one is Measure.SCANS else difference.one
    return None
