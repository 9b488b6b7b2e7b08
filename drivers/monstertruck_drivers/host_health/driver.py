"""Host monitor: samples the computer once a second and reports resource shortages."""

from dataclasses import asdict
from typing import Any, Final

from monstertruck_drivers.computer import Computer
from monstertruck_drivers.host_health.config import HostHealthConfig
from monstertruck_drivers.host_health.readings import Reading, busy_share, read_host
from monstertruck_drivers.thresholds import Threshold, ThresholdAlarm
from monstertruck_runtime.clock import Clock, Lead, Schedule
from monstertruck_runtime.ports import EventSink, Publisher, Ready
from monstertruck_schemas.event import Severity
from monstertruck_schemas.health import HostHealth
from monstertruck_schemas.reasons import Reason

SEVERITIES: Final = {Reason.DISK_LOW: Severity.ERROR, Reason.MEMORY_LOW: Severity.ERROR}
"""Severities other than WARNING."""


class HostHealthDriver:
    """Publishes the computer's health, and reports each shortage when it starts and when it ends.

    Args:
        config: limits.
        computer: monitored computer.
        clock: time.
        out: host health.
        events: shortages and recoveries.
        name: service name.
    """

    def __init__(
        self,
        config: HostHealthConfig,
        computer: Computer,
        clock: Clock,
        out: Publisher[HostHealth],
        events: EventSink,
        name: str = "host",
    ) -> None:
        self.name = name
        self._config = config
        self._clock = clock
        self._out = out
        self._events = events
        self._root = computer.root
        self._disk = computer.disk
        self._offload = computer.machine.offload
        self._before: Reading | None = None
        self._alarms = {
            Reason.HOST_HOT: ThresholdAlarm(Threshold(config.hot, config.hot_clear, config.after)),
            Reason.HOST_THROTTLED: ThresholdAlarm(Threshold(0.5, 0.25, config.after)),
            Reason.HOST_BUSY: ThresholdAlarm(Threshold(config.busy, config.busy_clear, config.busy_after)),
            Reason.MEMORY_LOW: ThresholdAlarm(Threshold(config.memory, config.memory_clear, config.after)),
            Reason.DISK_LOW: ThresholdAlarm(Threshold(config.disk, config.disk_clear, config.after)),
        }

    async def run(self, ready: Ready) -> None:
        """Sample until cancelled.

        Raises:
            DeviceError: /proc cannot be read, or the free disk space cannot be determined.
            ProtocolError: a /proc file does not have its documented format.
        """
        schedule = Schedule(self._clock, self._config.rate, Lead.IN_THREADS)
        while True:
            await schedule.next()
            stamp = self._clock.now()
            reading = await self._offload(lambda: read_host(self._root, self._disk(self._config.disk_path)))
            health = self._health(stamp, reading)
            self._out.put(health)
            self._judge(health)
            self._before = reading
            ready()

    def _health(self, stamp: int, reading: Reading) -> HostHealth:
        return HostHealth(
            stamp=stamp,
            received=self._clock.now(),
            seq=self._out.next_seq(),
            load=reading.load,
            cores=reading.cores,
            cpu=None if self._before is None else busy_share(self._before.times, reading.times),
            temperature=reading.temperature,
            frequency=reading.frequency,
            frequency_share=reading.frequency_share,
            throttled=self._is_throttled(reading),
            memory_total=reading.memory_total,
            memory_available=reading.memory_available,
            disk_total=reading.disk.total,
            disk_free=reading.disk.free,
            daemon_memory=reading.daemon_memory,
            daemon_files=reading.daemon_files,
        )

    def _is_throttled(self, reading: Reading) -> bool:
        hotter = self._before is not None and reading.throttle_events > self._before.throttle_events
        capped = reading.frequency_share is not None and reading.frequency_share < self._config.slow
        return reading.firmware_throttled or hotter or capped

    def _judge(self, health: HostHealth) -> None:
        values: dict[Reason, float | None] = {
            Reason.HOST_HOT: health.temperature,
            Reason.HOST_THROTTLED: float(health.throttled),
            Reason.HOST_BUSY: health.cpu,
            Reason.MEMORY_LOW: health.memory_available / max(health.memory_total, 1),
            Reason.DISK_LOW: float(health.disk_free),
        }
        for reason, value in values.items():
            alarm = self._alarms[reason]
            if not alarm.update(health.stamp, value):
                continue
            if alarm.active:
                self._events(reason, SEVERITIES.get(reason, Severity.WARNING), self.name, reason.text, value=value)
            else:
                self._events(Reason.OK, Severity.INFO, self.name, f"over: {reason.text}", value=value)


async def identify(computer: Computer, clock: Clock, settings: HostHealthConfig) -> dict[str, Any]:
    """Read the computer's health once.

    Returns:
        JSON-compatible dict: the fields of ``Reading``.

    Raises:
        DeviceError: /proc cannot be read.
    """
    disk = computer.disk(settings.disk_path)
    return asdict(await computer.machine.offload(lambda: read_host(computer.root, disk)))
