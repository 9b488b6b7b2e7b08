"""Clock watch for a scanner: reports restarts and slews, and ends a session whose scans stay late."""

from monstertruck_drivers.scanning.clock_map import ClockMap
from monstertruck_runtime.clock import SECOND
from monstertruck_runtime.errors import DeviceTimeoutError
from monstertruck_runtime.ports import EventSink
from monstertruck_schemas.event import Severity
from monstertruck_schemas.reasons import Reason


class ClockWatch:
    """Stamps one scanner's scans.

    Args:
        events: event sink for restarts and slews of the scanner's clock.
        source: service name of the scanner.
    """

    def __init__(self, events: EventSink, source: str) -> None:
        self._events, self._source = events, source
        self._slew_due = 0
        self._late_since: int | None = None

    def stamp(self, mapping: ClockMap, counter: int, arrival: int, port: str) -> int:
        """Return the daemon's time (ns) at which the scanner's counter was ``counter``.

        Args:
            mapping: clock map of the current session.
            counter: as in ``ClockMap.stamp``.
            arrival: as in ``ClockMap.stamp``.
            port: port name.

        Raises:
            DeviceTimeoutError: scans have been late for several seconds.
        """
        restarts, slews = mapping.restarts, mapping.slews
        stamp = mapping.stamp(counter, arrival)
        if mapping.restarts > restarts:
            self._events(
                Reason.DEVICE_FAULT, Severity.WARNING, self._source, "sensor's clock restarted", counter=counter
            )
        if mapping.slews > slews and arrival >= self._slew_due:
            slew_period = 60.0  # minimum interval between reports of clocks that run apart (s)
            self._slew_due = arrival + round(slew_period * SECOND)
            text = f"the clocks of sensor and computer drift apart by {mapping.drift:.1%}: compensated"
            self._events(Reason.CLOCK_DRIFT, Severity.WARNING, self._source, text)
        self._check_age(mapping, arrival, port)
        return stamp

    def _check_age(self, mapping: ClockMap, arrival: int, port: str) -> None:
        too_late = 0.3  # maximum added latency of a scan since the start (s); later scans are of little use
        # Maximum duration of late scans (s); then the session restarts, which repeats the clock comparison.
        late_for = 3.0
        if mapping.late < too_late * SECOND:
            self._late_since = None
        elif self._late_since is None:
            self._late_since = arrival
        elif arrival - self._late_since > late_for * SECOND:
            self._late_since = None
            raise DeviceTimeoutError(
                f"{port}: scan latency grew by {mapping.late / SECOND:.1f} s since the start: the session restarts"
            )
