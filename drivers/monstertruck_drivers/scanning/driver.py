"""Base of the scanners' drivers."""

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
        port: port of the scanner.
        clock: time.
        out: publisher of the scans.
        events: faults and changes of the scanner's clock.
        name: name of the service.
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
