"""The scanner's millisecond counter on the daemon's clock: drift, slews of either clock, restarts, late scans.

A scan arrives a latency after its counter value, and never sooner than the least latency; so the lower envelope of
(arrival - counter) shows how both clocks run apart, and one comparison of both at the start shows the latency.
"""

from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final

from monstertruck_runtime.clock import SECOND

MILLISECOND: Final = 1_000_000
BLOCK: Final = 10
"""Scans of which the promptest one stands for all in the estimate of the drift."""
BLOCKS: Final = 20
"""Blocks of that estimate, at most."""
RECENT: Final = 6
"""Blocks of the estimate at its start, and after a clock was slewed."""
BREAK: Final = 3e-3
"""Difference of the drifts by recent and by all blocks that only a slew explains."""
GREATEST_DRIFT: Final = 0.12
"""Greatest relative drift of a clock that is slewed: chrony and the kernel slew by a tenth at most."""
PROMPT: Final = 8
"""Scans of which one at least is prompt: all above the envelope means that the clocks run apart."""


@dataclass(frozen=True, slots=True)
class Anchor:
    """One comparison of both clocks."""

    counter: int
    """Sensor's milliseconds."""
    host: int
    """The daemon's time when the counter said so, ns."""
    round_trip: int = 0
    """How long the exchange took, ns; half of it bounds the error."""


class ClockMap:
    """Stamps of counter values, never going backwards.

    Args:
        nominal_latency: ns from a counter value to the arrival of its scan, if nothing delays it; used where it cannot
            be measured (no ``anchor``, or the counter restarted before the first scan), and none that is measured is
            less, but for a slew: while the drift is not known yet, a fast sensor's scans seem to arrive too soon.
        anchor: comparison made at start.
        turn: milliseconds after which the counter starts at 0 again.
    """

    def __init__(self, nominal_latency: int, anchor: Anchor | None = None, *, turn: int = 1 << 24) -> None:
        self._turn = turn * MILLISECOND
        self.restarts = 0
        """How often the counter restarted."""
        self.late = 0
        """By how much all of the newest scans arrived later than the latency explains, ns; 0 = they do not."""
        self._latency = nominal_latency
        self._least_latency = round(nominal_latency * (1.0 - GREATEST_DRIFT))
        self._reference: int | None = None if anchor is None else anchor.host
        self._counter: int | None = None if anchor is None else anchor.counter
        self._host = 0 if anchor is None else anchor.host
        self._elapsed = 0  # sensor's ns since the first comparison
        self._envelope = 0.0
        self._drift = Drift()
        self._settling: list[tuple[int, int]] = []
        self._newest: deque[tuple[int, int]] = deque(maxlen=PROMPT)
        self._window: deque[tuple[int, int]] = deque(maxlen=60)  # scans of which the promptest one is the envelope
        self._stamp: int | None = None

    @property
    def slews(self) -> int:
        """How often the drift changed as it does only when a clock is slewed, or no longer is."""
        return self._drift.breaks

    @property
    def drift(self) -> float:
        """By how much slower than the daemon's the sensor's clock runs, s/s."""
        return self._drift.rate

    def stamp(self, counter: int, arrival: int) -> int:
        """The daemon's time, ns, at which the sensor's counter said ``counter``.

        Args:
            counter: milliseconds, later than that of the previous call.
            arrival: when the last byte came, ns.
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
        # Disagreement of both clocks over one scan that only a restarted counter can explain, ns.
        restart = 1000 * MILLISECOND
        if abs(self._signed(step - waited)) > restart:
            self.restarts += 1
            self._restart(waited, arrival)
            return
        self._elapsed += step
        self._take(self._elapsed, arrival - self._elapsed)

    def _take(self, elapsed: int, sample: int) -> None:
        """Find the envelope at a new sample."""
        self._newest.append((elapsed, sample))
        prompt = self._lowest(self._newest)
        above = prompt - self._lowest(self._window) if len(self._newest) == PROMPT else 0.0
        late = 100 * MILLISECOND  # height from which on it does not, ns: no clock jumps, so the scans are late
        self.late = round(above) if above > late else 0
        if not self.late:
            breaks, drift = self.slews, self.drift
            self._drift.add(elapsed, sample)
            slewed = self.slews > breaks or (abs(self.drift - drift) > BREAK and not self._is_steady())
            if slewed and self._reference is not None:
                # BeamSamples since the slew say nothing of the latency.
                before = self._settling[: max(len(self._settling) - RECENT * BLOCK, BLOCK)]
                self._find_latency(self._reference, before, drift)
                self._keep_latency()
            # Height of such scans above the envelope from which on it follows them, ns: more than the jitter of USB.
            apart = 30 * MILLISECOND
            if above > apart or abs(self.drift - drift) > BREAK:
                self._window.clear()
                self._window.extend(self._newest)
            else:
                self._window.append((elapsed, sample))
        self._envelope = self._lowest(self._window)
        if self._reference is not None:
            self._settling.append((elapsed, sample))
            self._find_latency(self._reference, self._settling, self.drift)
            settle = 20 * SECOND  # how long the latency is being found, sensor's ns: by then the drift is known
            if elapsed > settle:
                self._keep_latency()

    def _is_steady(self) -> bool:
        """Whether the present drift, which has just been found, explains all samples since the comparison."""
        third = max(len(self._settling) // 3, 1)
        envelopes = [self._lowest(self._settling[at : at + third]) for at in range(0, len(self._settling), third)]
        steady = 15 * MILLISECOND  # difference of the envelopes of early and late samples that one drift explains, ns
        return not envelopes or max(envelopes) - min(envelopes) < steady

    def _lowest(self, samples: Iterable[tuple[int, int]]) -> float:
        """The envelope of samples at the newest one's time."""
        return min(sample + self.drift * (self._elapsed - elapsed) for elapsed, sample in samples)

    def _restart(self, waited: int, arrival: int) -> None:
        """The counter started again: by the latency found so far."""
        self._keep_latency()
        self._elapsed += waited
        self._newest.clear()
        self._window.clear()
        self._drift.forget()
        self._take(self._elapsed, arrival - self._elapsed)

    def _find_latency(self, reference: int, samples: Iterable[tuple[int, int]], drift: float) -> None:
        """The least time from the counter to the arrival, by the comparison at the start."""
        found = round(min(sample - reference - drift * elapsed for elapsed, sample in samples))
        self._latency = max(found, self._least_latency)

    def _signed(self, difference: int) -> int:
        """A difference of counters, ns, as the least one of all that a wrap makes equal."""
        return (difference + self._turn // 2) % self._turn - self._turn // 2

    def _keep_latency(self) -> None:
        """It is no longer looked for."""
        self._reference = None
        self._settling.clear()


class Drift:
    """Rate of the lower envelope, by its points in two halves of the newest blocks of samples."""

    def __init__(self) -> None:
        self.rate = 0.0
        """Ns per ns."""
        self.breaks = 0
        """How often it changed by more than ``BREAK`` at once."""
        self._blocks: deque[tuple[int, int]] = deque(maxlen=BLOCKS)
        self._block: list[tuple[int, int]] = []

    def add(self, elapsed: int, sample: int) -> None:
        """Take a sample, ns, at ``elapsed``, ns."""
        self._block.append((elapsed, sample))
        if len(self._block) < BLOCK:
            return
        self._blocks.append(self._lowest(self._block))
        self._block = []
        if len(self._blocks) < RECENT:
            return
        blocks = list(self._blocks)
        rate, recent = self._slope(blocks), self._slope(blocks[-RECENT:])
        if abs(rate - recent) > BREAK:
            rate = recent
            self.breaks += 1
            while len(self._blocks) > RECENT:
                self._blocks.popleft()
        if len(blocks) < BLOCKS // 2 and abs(rate) < BREAK:
            rate = 0.0  # no more than the jitter may make it
        self.rate = min(max(rate, -GREATEST_DRIFT), GREATEST_DRIFT)

    def forget(self) -> None:
        """The samples start again; the rate stays."""
        self._blocks.clear()
        self._block = []

    def _slope(self, blocks: list[tuple[int, int]]) -> float:
        """The present rate, corrected by how much lower or higher the second half is than the first."""
        middle = len(blocks) // 2
        low, high = (
            sample - self.rate * elapsed
            for elapsed, sample in (self._lowest(blocks[:middle]), self._lowest(blocks[-middle:]))
        )
        apart = blocks[-middle][0] - blocks[0][0]
        return self.rate + (high - low) / max(apart, 1)

    def _lowest(self, samples: list[tuple[int, int]]) -> tuple[int, int]:
        return min(samples, key=lambda pair: pair[1] - self.rate * pair[0])
