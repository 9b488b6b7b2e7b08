"""Convert samples from a turning head to scans: cut revolutions at the rear and resample them to equal angular steps.

The head measures at a constant rate while its speed varies, so the number of samples differs between revolutions.
Angles are fractions of a turn in the head's turning direction; 0 is the scanner's x axis.
"""

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from monstertruck_drivers.emulation import Array
from monstertruck_schemas.sensor import NO_ECHO, VALID_BEAM

MISSING: Final = NO_ECHO + 1
"""Code of a beam without information."""


class BeamSamples(NamedTuple):
    """Samples in measurement order; each array has shape (n,)."""

    turns: Array
    """Angle, modulo whole turns (turns)."""
    ranges: Array
    """Range (m); 0 = no return."""
    intensities: NDArray[np.uint8]
    """Strength of the return, in the scanner's unit."""
    times: Array
    """Instants after an origin of the caller's choice (ns)."""


class HeadTurn(NamedTuple):
    """One revolution at equal angular steps."""

    first: float
    """Angle of the first beam after the cut (turns)."""
    ranges: Array
    """Ranges, shape (n,) (m); 0 = no return, NaN = no sample."""
    intensities: NDArray[np.uint8]
    """Intensities, shape (n,)."""
    begin: float
    """Instant of the first beam on the samples' clock (ns)."""
    period: float
    """Duration of a whole turn (ns)."""

    @property
    def step(self) -> float:
        """Angle between neighbouring beams (turns)."""
        return 1.0 / len(self.ranges)


class TurnCutter:
    """Cuts samples into revolutions; drops samples before the first cut."""

    def __init__(self) -> None:
        self._parts: list[BeamSamples] = []
        self._at: float | None = None
        """Angle of the latest sample from the first cut (turns); its integer part numbers the revolution."""
        self._begun = False

    def add(self, samples: BeamSamples) -> list[BeamSamples]:
        """Add samples; return the completed revolutions, with angles from the cut, 0 to 1."""
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
    """Resample a revolution to equal steps, moving each sample to the nearest; None if there are too few samples.

    If two samples fall on one step, the shorter range is kept. The step is the mean spacing of neighbours. The beams
    are at the mean phase of the samples, so no sample moves by more than half a step while the head turns evenly. The
    last beam is at the last sample: if there is one sample more than steps, the first is dropped, because the last has
    the same direction.

    Args:
        samples: one revolution, with angles from the cut, 0 to 1.
    """
    order = np.argsort(samples.turns, kind="stable")
    turns = samples.turns[order]
    step = _mean_step(turns)
    if step is None:
        return None
    count = max(round(1.0 / step), 1)
    phase = float(np.angle(np.exp(2j * np.pi * turns * count).mean())) / (2.0 * np.pi)
    beams = np.rint(turns * count - phase).astype(np.intp)
    first = max(int(beams[-1]) - count + 1, 0)
    order, beams = order[beams >= first], beams[beams >= first] - first
    phase += first
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
    """Return the mean spacing of increasing angles, without gaps (turns); None if there are too few angles."""
    apart = np.diff(turns)
    usual = float(np.median(apart)) if len(apart) >= 16 else 0.0  # fewer samples define no step
    gap = 4.0  # multiple of the median spacing beyond which samples between neighbours were lost
    return float(apart[apart < gap * usual].mean()) if usual > 0.0 else None


class ArrivalTimes:
    """Estimates the times of revolutions from arrival times, for a head whose samples carry no time.

    No sample arrives before its measurement, so the promptest sample fixes a revolution's time. No revolution begins
    later than the end of the previous one plus the time that the head may have lost by slowing down.

    Args:
        sample_time: interval between samples (ns).
    """

    def __init__(self, sample_time: float) -> None:
        self._sample_time = sample_time
        self._next: float | None = None
        """Start of the next revolution at unchanged speed (ns)."""

    def timed(self, samples: BeamSamples) -> BeamSamples:
        """Return a revolution with estimated times; ``samples.times`` are its arrival times, assuming no delay."""
        step = _mean_step(np.sort(samples.turns))
        if step is None:
            return samples
        period = self._sample_time / step
        turned = samples.turns * period
        begin = float((samples.times - turned).min())
        if self._next is not None and abs(begin - self._next) < period / 2:
            # Tolerance of a scanner's clock: a revolution may exceed the duration of its samples by this fraction.
            slower = 0.01
            begin = min(begin, self._next + slower * period)
        self._next = begin + period
        return samples._replace(times=begin + turned)


def codes_of(turn: HeadTurn, *, free: bool) -> NDArray[np.uint8]:
    """Return the beam codes of a revolution, as defined in ``LaserScan``.

    Args:
        turn: the revolution.
        free: whether a beam without a return is free up to the scanner's range; otherwise its code is ``MISSING``.
    """
    without = NO_ECHO if free else MISSING
    codes = np.where(turn.ranges > 0.0, VALID_BEAM, np.where(np.isnan(turn.ranges), MISSING, without))
    return codes.astype(np.uint8)
