"""What becomes of a scanner's clock while it is mapped: reports, and the end of a session whose scans stay late."""

from monstertruck_drivers.scanning.clock_map import ClockMap
from monstertruck_runtime.clock import SECOND
from monstertruck_runtime.errors import DeviceTimeoutError
from monstertruck_runtime.ports import EventSink
from monstertruck_schemas.event import Severity
from monstertruck_schemas.reasons import Reason


class ClockWatch:
    """Stamps of one scanner.

    Args:
        events: where restarts and slews of its clock are reported.
        source: name of its service.
    """

    def __init__(self, events: EventSink, source: str) -> None:
        self._events, self._source = events, source
        self._slew_due = 0
        self._late_since: int | None = None

    def stamp(self, mapping: ClockMap, counter: int, arrival: int, port: str) -> int:
        """The daemon's time at which the scanner's counter said ``counter``, ns.

        Args:
            mapping: of the present session.
            counter: as ``ClockMap.stamp``.
            arrival: likewise.
            port: name of the port.

        Raises:
            DeviceTimeoutError: scans have arrived late for seconds.
        """
        restarts, slews = mapping.restarts, mapping.slews
        stamp = mapping.stamp(counter, arrival)
        if mapping.restarts > restarts:
            self._events(
                Reason.DEVICE_FAULT, Severity.WARNING, self._source, "sensor's clock restarted", counter=counter
            )
        if mapping.slews > slews and arrival >= self._slew_due:
            slew_period = 60.0  # least seconds between two reports of clocks that run apart
            self._slew_due = arrival + round(slew_period * SECOND)
            text = f"the sensor's clock and the computer's run apart by {mapping.drift:.1%}: followed"
            self._events(Reason.CLOCK_DRIFT, Severity.WARNING, self._source, text)
        self._check_age(mapping, arrival, port)
        return stamp

    def _check_age(self, mapping: ClockMap, arrival: int, port: str) -> None:
        too_late = 0.3  # seconds by which scans arrive later than at the start, from which on they are worth little
        # Seconds of such scans after which the session restarts, and with it the comparison of the clocks.
        late_for = 3.0
        if mapping.late < too_late * SECOND:
            self._late_since = None
        elif self._late_since is None:
            self._late_since = arrival
        elif arrival - self._late_since > late_for * SECOND:
            self._late_since = None
            raise DeviceTimeoutError(
                f"{port}: scans arrive {mapping.late / SECOND:.1f} s later than at the start: begins anew"
            )
