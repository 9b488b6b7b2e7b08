"""Link monitor: reads the interface once a second."""

import math
from dataclasses import asdict
from typing import Any, Final

from monstertruck_drivers.computer import Computer
from monstertruck_drivers.link_quality.config import LinkQualityConfig
from monstertruck_drivers.link_quality.interfaces import Sample, choose, read_interfaces
from monstertruck_runtime.clock import SECOND, Clock, Lead, Schedule
from monstertruck_runtime.ports import EventSink, Publisher, Ready
from monstertruck_schemas.event import Severity
from monstertruck_schemas.health import LinkHealth, LinkLevel, LinkMedium
from monstertruck_schemas.reasons import Reason


class LinkJudge:
    """Rates the link quality of the monitored interface, which may change."""

    def __init__(self, config: LinkQualityConfig) -> None:
        self._smoothing = config.smoothing
        self._hysteresis = config.hysteresis
        self._bounds = (
            (LinkLevel.EXCELLENT, config.excellent),
            (LinkLevel.GOOD, config.good),
            (LinkLevel.FAIR, config.fair),
            (LinkLevel.POOR, config.poor),
            (LinkLevel.UNUSABLE, -math.inf),
        )
        self._forget()

    def _forget(self) -> None:
        self._name: str | None = None
        self._last = 0
        self._rank: int | None = None
        self.signal: float | None = None
        """Smoothed signal (dBm); None if unknown."""

    def update(self, time_ns: int, sample: Sample | None) -> LinkLevel:
        """Process one sample; None if the interface is missing."""
        if sample is None or not sample.connected:
            self._forget()
            return LinkLevel.DOWN
        if sample.medium is LinkMedium.ETHERNET:
            self._forget()
            return LinkLevel.EXCELLENT
        level = sample.signal.level if sample.signal is not None else None
        if level is None:
            self._forget()
            return LinkLevel.UNKNOWN
        if sample.name != self._name:
            self._forget()
        self._name = sample.name
        self.signal = self._smoothed(level, (time_ns - self._last) / SECOND)
        self._last = time_ns
        self._rank = self._ranked(self.signal)
        return self._bounds[self._rank][0]

    def _smoothed(self, level: float, elapsed: float) -> float:
        if self.signal is None or self._smoothing == 0:
            return level
        return level + (self.signal - level) * math.exp(-elapsed / self._smoothing)

    def _ranked(self, signal: float) -> int:
        """Return the best level whose limit is reached; a level above the current one also requires a margin."""
        for rank, (_, bound) in enumerate(self._bounds):
            climbing = self._rank is not None and rank < self._rank
            if signal >= bound + (self._hysteresis if climbing else 0.0):
                return rank
        raise AssertionError("the last limit is always reached")


CONCERNS: Final = {
    LinkLevel.POOR: (Reason.LINK_WEAK, Severity.WARNING),
    LinkLevel.UNUSABLE: (Reason.LINK_WEAK, Severity.WARNING),
    LinkLevel.DOWN: (Reason.LINK_DOWN, Severity.WARNING),
}
FINE: Final = (Reason.OK, Severity.INFO)


class LinkQualityDriver:
    """Publishes the link's quality and reports when it becomes weak, is lost or recovers.

    Heartbeats, not the signal, decide whether a station is connected; the signal level informs operators and planning.

    Args:
        config: interface and limits.
        computer: computer that has the interfaces.
        clock: time.
        out: link health.
        events: degradations and recoveries.
        name: service name.
    """

    def __init__(
        self,
        config: LinkQualityConfig,
        computer: Computer,
        clock: Clock,
        out: Publisher[LinkHealth],
        events: EventSink,
        name: str = "link",
    ) -> None:
        self.name = name
        self._config = config
        self._clock = clock
        self._out = out
        self._events = events
        self._root = computer.root
        self._offload = computer.machine.offload
        self._judge = LinkJudge(config)
        self._concern = FINE
        self._before: tuple[int, Sample] | None = None

    async def run(self, ready: Ready) -> None:
        """Sample until cancelled; unexpected or missing kernel output does not end the session."""
        schedule = Schedule(self._clock, self._config.rate, Lead.IN_THREADS)
        while True:
            await schedule.next()
            stamp = self._clock.now()
            samples = await self._offload(lambda: read_interfaces(self._root))
            self._publish(stamp, choose(samples, self._config.interface))
            ready()

    def _publish(self, stamp: int, sample: Sample | None) -> None:
        level = self._judge.update(stamp, sample)
        self._report(level, sample)
        receive, send = self._rates(stamp, sample)
        wifi = sample is not None and sample.medium is LinkMedium.WIFI
        signal = sample.signal if sample is not None and sample.connected else None
        self._out.put(
            LinkHealth(
                stamp=stamp,
                received=self._clock.now(),
                seq=self._out.next_seq(),
                interface=sample.name if sample is not None else None,
                medium=sample.medium if sample is not None else None,
                level=level,
                signal=self._judge.signal,
                raw_signal=signal.level if signal is not None else None,
                noise=signal.noise if signal is not None else None,
                bit_rate=sample.bit_rate if sample is not None and not wifi else None,
                receive_rate=receive,
                send_rate=send,
                errors=sample.errors if sample is not None else 0,
            )
        )
        self._before = None if sample is None else (stamp, sample)

    def _report(self, level: LinkLevel, sample: Sample | None) -> None:
        concern = CONCERNS.get(level, FINE)
        if concern == self._concern:
            return
        self._concern = concern
        name = sample.name if sample is not None else self._config.interface or "no interface"
        self._events(*concern, self.name, f"{name}: link is {level.value}", signal=self._judge.signal)

    def _rates(self, stamp: int, sample: Sample | None) -> tuple[float | None, float | None]:
        """Receive and transmit rates (bytes/s) since the last reading of the same interface."""
        if self._before is None or sample is None:
            return None, None
        then, before = self._before
        if before.name != sample.name or sample.received < before.received or sample.sent < before.sent:
            return None, None  # another interface, or its counters were reset
        seconds = (stamp - then) / SECOND
        return (sample.received - before.received) / seconds, (sample.sent - before.sent) / seconds


async def identify(computer: Computer, clock: Clock, settings: LinkQualityConfig) -> dict[str, Any]:
    """List the interfaces.

    Returns:
        JSON-compatible dict: ``interfaces`` and ``chosen``, the interface that is monitored if none is configured.
    """
    samples = await computer.machine.offload(lambda: read_interfaces(computer.root))
    chosen = choose(samples, None)
    return {"interfaces": [asdict(sample) for sample in samples], "chosen": chosen.name if chosen else None}
