"""Base class of the scanner drivers."""

from typing import Generic, TypeVar

from monstertruck_drivers.link import Port
from monstertruck_drivers.scanning.clock_watch import ClockWatch
from monstertruck_runtime.clock import Clock
from monstertruck_runtime.ports import EventSink, Publisher
from monstertruck_schemas.sensor import LaserScan

C = TypeVar("C")


class ScannerDriver(Generic[C]):
    """Scanner on a port: a tty or a network socket.

    Args:
        config: settings.
        port: the scanner's port.
        clock: time.
        out: scan publisher.
        events: scanner faults and clock changes.
        name: service name.
    """

    def __init__(
        self,
        config: C,
        port: Port,
        clock: Clock,
        out: Publisher[LaserScan],
        events: EventSink,
        name: str = "lidar",
    ) -> None:
        self.name = name
        self._config, self._port, self._clock, self._out, self._events = config, port, clock, out, events
        self._watch = ClockWatch(events, name)
