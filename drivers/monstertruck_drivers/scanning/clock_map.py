"""Map the scanner's millisecond counter to the daemon's clock: drift, slews of either clock, restarts, late scans.

A scan never arrives sooner after its counter value than the minimum latency. The lower envelope of (arrival - counter)
therefore shows the drift between the two clocks; one clock comparison at the start gives the latency.
"""

from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final

from monstertruck_runtime.clock import MILLISECOND, SECOND

BLOCK: Final = 10
"""Scans per block; the drift estimate uses only the promptest scan of a block."""
RECENT: Final = 6
"""Blocks in the drift estimate at its start, and after a clock was slewed."""
GREATEST_DRIFT: Final = 0.12
"""Maximum relative drift of a slewed clock: chrony and the kernel slew by at most a tenth."""


@dataclass(frozen=True, slots=True)
class Anchor:
    """One comparison of the two clocks."""

    counter: int
    """Counter of the sensor (ms)."""
    host: int
    """Daemon's time at this counter value (ns)."""
    round_trip: int = 0
    """Duration of the exchange (ns); half of it bounds the error."""


class ClockMap:
    """Converts counter values to stamps, which never go backwards.

    Args:
        nominal_latency: time from a counter value to the arrival of its scan without delay (ns). Used where the latency
            cannot be measured (no ``anchor``, or the counter restarted before the first scan). It is also the lower
            bound of a measured latency, except for a slew: while the drift is still unknown, scans from a sensor with a
            fast clock seem to arrive too soon.
        anchor: clock comparison made at the start.
        turn: counter period (ms), after which the counter restarts at 0.
    """

    def __init__(self, nominal_latency: int, anchor: Anchor | None = None, *, turn: int = 1 << 24) -> None:
        self._turn = turn * MILLISECOND
        self.restarts = 0
        """Number of counter restarts."""
        self.late = 0
        """Delay of all recent scans beyond the latency (ns); 0 if they are on time."""
        self._latency = nominal_latency
        self._least_latency = round(nominal_latency * (1.0 - GREATEST_DRIFT))
        self._reference: int | None = None if anchor is None else anchor.host
        self._counter: int | None = None if anchor is None else anchor.counter
        self._host = 0 if anchor is None else anchor.host
        self._elapsed = 0  # sensor time since the first comparison (ns)
        self._envelope = 0.0
        self._drift = Drift()
        self._settling: list[tuple[int, int]] = []
        self._newest: deque[tuple[int, int]] = deque(maxlen=8)  # at least one of them is prompt
        self._window: deque[tuple[int, int]] = deque(maxlen=60)  # its promptest scan is the envelope
        self._stamp: int | None = None

    @property
    def slews(self) -> int:
        """Number of drift changes that only the start or end of a slew can explain."""
        return self._drift.breaks

    @property
    def drift(self) -> float:
        """Drift of the sensor's clock (s/s), positive if it runs slower than the daemon's clock."""
        return self._drift.rate

    def stamp(self, counter: int, arrival: int) -> int:
        """Return the daemon's time (ns) at which the sensor's counter was ``counter``.

        Args:
            counter: counter value (ms), later than in the previous call.
            arrival: arrival time of the last byte (ns).
        """
        self._follow(counter, arrival)
        stamp = self._elapsed + round(self._envelope) - self._latency
        if self._stamp is not None:
            stamp = max(stamp, self._stamp + 1)
        self._stamp = stamp
        return stamp

    def _follow(self, counter: int, arrival: int) -> None:
        waited = arrival - self._host
        previous, self._counter, self._host = self._counter, counter, arrival
        if previous is None:
            self._take(0, arrival)
            return
        step = (counter - previous) * MILLISECOND % self._turn
        # Disagreement of both clocks over one scan that only a counter restart can explain (ns).
        restart = 1000 * MILLISECOND
        if abs(self._signed(step - waited)) > restart:
            self.restarts += 1
            self._restart(waited, arrival)
            return
        self._elapsed += step
        self._take(self._elapsed, arrival - self._elapsed)

    def _take(self, elapsed: int, sample: int) -> None:
        """Update the envelope with a new sample."""
        self._newest.append((elapsed, sample))
        prompt, full = self._lowest(self._newest), len(self._newest) == self._newest.maxlen
        above = prompt - self._lowest(self._window) if full else 0.0  # higher only if the clocks run apart
        late = 100 * MILLISECOND  # minimum height (ns) of late scans: clocks do not jump, so the scans are late
        self.late = round(above) if above > late else 0
        if not self.late:
            breaks, drift = self.slews, self.drift
            self._drift.add(elapsed, sample)
            slewed = self.slews > breaks or (_differ(self.drift, drift) and not self._is_steady())
            if slewed and self._reference is not None:
                # Samples since the slew carry no information about the latency.
                before = self._settling[: max(len(self._settling) - RECENT * BLOCK, BLOCK)]
                self._find_latency(self._reference, before, drift)
                self._keep_latency()
            # Height of recent scans beyond which the envelope follows them (ns): more than the jitter of USB.
            apart = 30 * MILLISECOND
            if above > apart or _differ(self.drift, drift):
                self._window.clear()
                self._window.extend(self._newest)
            else:
                self._window.append((elapsed, sample))
        self._envelope = self._lowest(self._window)
        if self._reference is not None:
            self._settling.append((elapsed, sample))
            self._find_latency(self._reference, self._settling, self.drift)
            settle = 20 * SECOND  # duration of the latency search (sensor's ns): by then the drift is known
            if elapsed > settle:
                self._keep_latency()

    def _is_steady(self) -> bool:
        """Whether the drift just found explains all samples since the comparison."""
        third = max(len(self._settling) // 3, 1)
        envelopes = [self._lowest(self._settling[at : at + third]) for at in range(0, len(self._settling), third)]
        steady = 15 * MILLISECOND  # envelope difference of early and late samples that a constant drift explains (ns)
        return not envelopes or max(envelopes) - min(envelopes) < steady

    def _lowest(self, samples: Iterable[tuple[int, int]]) -> float:
        """Return the lower envelope of samples at the time of the latest sample."""
        return min(sample + self.drift * (self._elapsed - elapsed) for elapsed, sample in samples)

    def _restart(self, waited: int, arrival: int) -> None:
        """Continue after a counter restart, with the latency known so far."""
        self._keep_latency()
        self._elapsed += waited
        self._newest.clear()
        self._window.clear()
        self._drift.forget()
        self._take(self._elapsed, arrival - self._elapsed)

    def _find_latency(self, reference: int, samples: Iterable[tuple[int, int]], drift: float) -> None:
        """Find the minimum time from counter value to arrival, using the comparison at the start."""
        found = round(min(sample - reference - drift * elapsed for elapsed, sample in samples))
        self._latency = max(found, self._least_latency)

    def _signed(self, difference: int) -> int:
        """Return a counter difference (ns) as its smallest equivalent modulo the counter period."""
        return (difference + self._turn // 2) % self._turn - self._turn // 2

    def _keep_latency(self) -> None:
        """Keep the current latency and end the search."""
        self._reference = None
        self._settling.clear()


class Drift:
    """Slope of the lower envelope, from its points in the two halves of the latest sample blocks."""

    def __init__(self) -> None:
        self.rate = 0.0
        """Drift (ns/ns)."""
        self.breaks = 0
        """Number of sudden changes that only a slew explains."""
        self._most = 20  # blocks
        self._blocks: deque[tuple[int, int]] = deque(maxlen=self._most)
        self._block: list[tuple[int, int]] = []

    def add(self, elapsed: int, sample: int) -> None:
        """Add a sample (ns) taken at ``elapsed`` (ns)."""
        self._block.append((elapsed, sample))
        if len(self._block) < BLOCK:
            return
        self._blocks.append(self._lowest(self._block))
        self._block = []
        if len(self._blocks) < RECENT:
            return
        blocks = list(self._blocks)
        rate, recent = self._slope(blocks), self._slope(blocks[-RECENT:])
        if _differ(rate, recent):
            rate = recent
            self.breaks += 1
            while len(self._blocks) > RECENT:
                self._blocks.popleft()
        if len(blocks) < self._most // 2 and not _differ(rate, 0.0):
            rate = 0.0  # jitter alone may cause such a rate
        self.rate = min(max(rate, -GREATEST_DRIFT), GREATEST_DRIFT)

    def forget(self) -> None:
        """Drop the samples but keep the rate."""
        self._blocks.clear()
        self._block = []

    def _slope(self, blocks: list[tuple[int, int]]) -> float:
        """Return the current rate, corrected by the height difference between the second half and the first."""
        middle = len(blocks) // 2
        low, high = (
            sample - self.rate * elapsed
            for elapsed, sample in (self._lowest(blocks[:middle]), self._lowest(blocks[-middle:]))
        )
        apart = blocks[-middle][0] - blocks[0][0]
        return self.rate + (high - low) / max(apart, 1)

    def _lowest(self, samples: list[tuple[int, int]]) -> tuple[int, int]:
        return min(samples, key=lambda pair: pair[1] - self.rate * pair[0])


def _differ(rate: float, other: float) -> bool:
    """Whether only a slew can explain the difference between two drifts (s/s)."""
    return abs(rate - other) > 3e-3
