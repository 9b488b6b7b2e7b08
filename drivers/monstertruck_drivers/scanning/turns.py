"""From samples of a turning head to scans: revolutions are cut at the rear, their samples put onto equal steps.

A turning head measures at a steady rate while its speed varies, so the number of samples differs from turn to turn.
Angles are fractions of a turn in the sense in which the head turns, 0 = the scanner's x axis.
"""

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from monstertruck_drivers.emulation import Array
from monstertruck_schemas.sensor import NO_ECHO, VALID_BEAM

MISSING: Final = NO_ECHO + 1
"""Code of a beam that says nothing."""


class BeamSamples(NamedTuple):
    """BeamSamples in the order in which they were measured; each of shape (n,)."""

    turns: Array
    """Angle, any number of whole turns left out."""
    ranges: Array
    """m; 0 = no return."""
    intensities: NDArray[np.uint8]
    """Strength of the return, in the scanner's own measure."""
    times: Array
    """Instants, ns after an instant of the caller's choice."""


class HeadTurn(NamedTuple):
    """One revolution on equal steps."""

    first: float
    """Angle of the first beam behind the cut, turns."""
    ranges: Array
    """Shape (n,), m; 0 = no return, NaN = no sample."""
    intensities: NDArray[np.uint8]
    """Shape (n,)."""
    begin: float
    """Instant of the first beam, ns on the samples' clock."""
    period: float
    """Time of a whole turn, ns."""

    @property
    def step(self) -> float:
        """Angle between neighbouring beams, turns."""
        return 1.0 / len(self.ranges)


class TurnCutter:
    """Collects samples and cuts them into revolutions; what comes before the first cut is dropped."""

    def __init__(self) -> None:
        self._parts: list[BeamSamples] = []
        self._at: float | None = None
        """Angle of the newest sample, in turns since the first one's cut; the whole part numbers the revolution."""
        self._begun = False

    def add(self, samples: BeamSamples) -> list[BeamSamples]:
        """Revolutions that became complete, their angles behind the cut, 0 to 1."""
        if not len(samples.turns):
            return []
        behind = np.mod(samples.turns - 0.5, 1.0)  # where a revolution is cut
        if self._at is None:
            self._at = float(behind[0])
        moved = np.mod(np.diff(behind, prepend=self._at % 1.0) + 0.5, 1.0) - 0.5
        at = self._at + np.cumsum(moved)
        number = np.floor(at).astype(np.int64)
        present, newest = int(np.floor(self._at)), int(number.max())
        done = []
        for each in range(present, newest + 1):
            if each > present:
                if self._begun and self._parts:
                    done.append(BeamSamples(*map(np.concatenate, zip(*self._parts, strict=True))))
                self._begun, self._parts = True, []
            chosen = number == each
            if chosen.any():
                part = BeamSamples(*(values[chosen] for values in samples))
                self._parts.append(part._replace(turns=at[chosen] - each))
        self._at = float(at.max()) - present
        return done


def on_equal_steps(samples: BeamSamples) -> HeadTurn | None:
    """A revolution on equal steps, each sample at the nearest; None if the samples are too few to tell the step.

    The nearer of two samples at one step counts. The step is the mean distance of neighbours, and the first beam lies
    where the samples do on average, so that no sample moves by more than half a step while the head turns evenly.

    Args:
        samples: of one revolution, angles behind the cut, 0 to 1.
    """
    order = np.argsort(samples.turns, kind="stable")
    turns = samples.turns[order]
    step = _mean_step(turns)
    if step is None:
        return None
    count = max(round(1.0 / step), 1)
    phase = float(np.angle(np.exp(2j * np.pi * turns * count).mean())) / (2.0 * np.pi)
    beams = np.clip(np.rint(turns * count - phase).astype(np.intp), 0, count - 1)
    rate, begin = np.polyfit(samples.turns, samples.times, 1)
    if rate <= 0.0:
        return None
    ranges, strengths = np.full(count, np.inf), np.zeros(count, np.uint8)
    measured = samples.ranges[order]
    np.minimum.at(ranges, beams, np.where(measured > 0.0, measured, np.inf))
    met = np.zeros(count, bool)
    met[beams] = True
    shown = (ranges[beams] == measured) & (measured > 0.0)
    strengths[beams[shown]] = samples.intensities[order][shown]
    ranges = np.where(np.isfinite(ranges), ranges, np.where(met, 0.0, np.nan))
    return HeadTurn(phase / count, ranges, strengths, float(begin + rate * phase / count), float(rate))


def _mean_step(turns: Array) -> float | None:
    """Mean distance of neighbouring angles, rising, turns, gaps left out; None if they are too few."""
    apart = np.diff(turns)
    usual = float(np.median(apart)) if len(apart) >= 16 else 0.0  # BeamSamples without which a revolution has no step
    gap = 4.0  # neighbours so many usual distances apart have lost samples between them
    return float(apart[apart < gap * usual].mean()) if usual > 0.0 else None


class ArrivalTimes:
    """Times the revolutions of a head whose samples carry no time, by when they came.

    No sample comes before it was measured, so the promptest one of a revolution tells where it lies; and no revolution
    begins later than the one before ended, but for what the head may have slowed down.

    Args:
        sample_time: from sample to sample, ns.
    """

    def __init__(self, sample_time: float) -> None:
        self._sample_time = sample_time
        self._next: float | None = None
        """When the next revolution begins, if the head turns as before."""

    def timed(self, samples: BeamSamples) -> BeamSamples:
        """A revolution on times of its own; ``samples.times``: as if each had come at once."""
        step = _mean_step(np.sort(samples.turns))
        if step is None:
            return samples
        period = self._sample_time / step
        turned = samples.turns * period
        begin = float((samples.times - turned).min())
        if self._next is not None and abs(begin - self._next) < period / 2:
            # Share by which a revolution may take longer than its samples tell: the tolerance of a scanner's clock.
            slower = 0.01
            begin = min(begin, self._next + slower * period)
        self._next = begin + period
        return samples._replace(times=begin + turned)


def codes_of(turn: HeadTurn, *, free: bool) -> NDArray[np.uint8]:
    """Codes of a revolution's beams as ``LaserScan`` has them.

    Args:
        turn: the revolution.
        free: whether a beam without a return is free as far as the scanner reaches; it says nothing otherwise.
    """
    without = NO_ECHO if free else MISSING
    codes = np.where(turn.ranges > 0.0, VALID_BEAM, np.where(np.isnan(turn.ranges), MISSING, without))
    return codes.astype(np.uint8)
