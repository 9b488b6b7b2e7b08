"""Sensor checks: silent devices, failed services, drive faults, tilt and battery."""

from collections.abc import Iterator, Sequence
from typing import Any, Final

from monstertruck_runtime.clock import SECOND
from monstertruck_schemas.base import Message
from monstertruck_schemas.event import Cause, Measurement
from monstertruck_schemas.health import HealthTable, ServiceState
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.sensor import Attitude, BatteryLevel
from monstertruck_schemas.topics import Topic
from monstertruckd.gate.checks import Check, GateView, PaceLimit, Tick
from monstertruckd.gate.motion import Course
from monstertruckd.gate.samples import STALE_SENSORS, age

DRIVE_LOSSES: Final = (Reason.DEVICE_RESTARTED, Reason.DEVICE_STOPPED)
"""Reasons for the loss of a drive's service that require arming again, however short the loss."""


class TickCheck(Check):
    """Stops the robot after a gap between two ticks, until the ticks have been punctual for ``stall_dwell``."""

    reasons = (Reason.TICK_STALLED,)

    def __init__(self, view: GateView) -> None:
        super().__init__(view)
        self._stalled_until = 0
        self._pause = 0.0
        """Latest excessive pause between two ticks, s."""

    def observe(self, seen: Message | Tick, topic: Topic[Any] | None) -> None:
        """Measure the time between ticks."""
        if isinstance(seen, Tick) and seen.elapsed > self.view.config.tick_stall * SECOND:
            self._stalled_until = seen.now + round(self.view.config.stall_dwell * SECOND)
            self._pause = seen.elapsed / SECOND

    def reason(self, now: int) -> Iterator[Reason]:
        """Report a recent gap."""
        if now < self._stalled_until:
            yield Reason.TICK_STALLED

    def figures(self, reason: Reason, now: int) -> Iterator[Measurement]:
        """Duration of the gap."""
        yield Measurement(name="pause", value=self._pause, unit="s", limit=self.view.config.tick_stall)


class DriveFaultCheck(Check):
    """Stops the robot on a fault of a drive controller, or on a loss of its service that requires arming again."""

    reasons = (Reason.DRIVE_FAULT, *DRIVE_LOSSES)

    def __init__(self, view: GateView) -> None:
        super().__init__(view)
        self._losses: set[Reason] = set()
        """Reasons of drive services that are down."""
        self._reported: set[Reason] = set()
        """Losses reported since the latest tick."""
        self._judged: set[Reason] = set()
        """Losses reported before the latest tick; this tick must judge them even if they are over."""

    def observe(self, seen: Message | Tick, topic: Topic[Any] | None) -> None:
        """Process health reports from the drive services."""
        if isinstance(seen, Tick):
            self._judged, self._reported = self._reported, set()
        elif isinstance(seen, HealthTable):
            self._losses = {
                service.reason
                for service in seen.services
                if service.reason in DRIVE_LOSSES and self.view.samples.gives(service.name) is Reason.DRIVE_STALE
            }
            self._reported |= self._losses

    def reason(self, now: int) -> Iterator[Reason]:
        """Report faults and losses."""
        if self.view.samples.faults:
            yield Reason.DRIVE_FAULT
        losses = self._losses | self._reported | self._judged
        yield from (reason for reason in DRIVE_LOSSES if reason in losses)

    def figures(self, reason: Reason, now: int) -> Iterator[Measurement]:
        """Fault codes of the drives."""
        if reason is Reason.DRIVE_FAULT:
            for drive in self.view.samples.faults:
                code = drive.fault_code
                yield Measurement(name="fault code", value=None if code is None else float(code), age=age(drive, now))


class ServiceCheck(Check):
    """Stops the robot when a required service has failed."""

    reasons = (Reason.SERVICE_FAILED,)

    def __init__(self, view: GateView) -> None:
        super().__init__(view)
        self._failed: tuple[str, ...] = ()

    def observe(self, seen: Message | Tick, topic: Topic[Any] | None) -> None:
        """Process the health of the services."""
        if isinstance(seen, HealthTable):
            tolerated = self.view.config.tolerated_failures
            failed = (service.name for service in seen.services if service.state is ServiceState.FAILED)
            self._failed = tuple(name for name in failed if name not in tolerated)

    def reason(self, now: int) -> Iterator[Reason]:
        """Report failed services."""
        if self._failed:
            yield Reason.SERVICE_FAILED

    def text(self, reason: Reason) -> str:
        """Text of the reason, with the names of the failed services."""
        return f"{reason.text}: {', '.join(self._failed)}"

    def describe(self, reason: Reason, now: int, since: int) -> Iterator[Cause]:
        """One cause per failed service."""
        for name in self._failed:
            yield Cause(reason=reason, source=name, since=since, text=f"{reason.text}: {name}")


class StalenessCheck(Check):
    """Stops the robot when a critical sensor has no fresh valid sample."""

    reasons = tuple(STALE_SENSORS)

    def reason(self, now: int) -> Iterator[Reason]:
        """Report stale critical sensors, worst first."""
        view = self.view
        fresh = view.samples.fresh(now)
        for reason, limit in view.samples.sensor_limits().items():
            steered = view.chassis.steered or reason is not Reason.STEERING_STALE
            if limit.critical and steered and not fresh[reason]:
                yield reason

    def describe(self, reason: Reason, now: int, since: int) -> Iterator[Cause]:
        """The silent sensor, with the age of its latest valid sample."""
        staleness = self.view.samples.staleness(reason, now)
        figures = [Measurement(name="age", value=staleness.age, unit="s", limit=staleness.limit)]
        if staleness.refused is not None:
            figures.append(staleness.refused)
        yield Cause(
            reason=reason,
            source=staleness.source.value,
            since=since if staleness.since is None else staleness.since,
            text=reason.text,
            measurements=tuple(figures),
        )


class TiltCheck(Check):
    """Slows or stops a tilted robot; both limits have a hysteresis."""

    reasons = (Reason.TILT_STOP, Reason.TILT_SLOW)

    def __init__(self, view: GateView) -> None:
        super().__init__(view)
        self._slow = False
        self._stop = False

    def observe(self, seen: Message | Tick, topic: Topic[Any] | None) -> None:
        """Compare the tilt of a valid attitude with the limits."""
        if isinstance(seen, Attitude) and seen is self.view.samples.attitude:
            tilt, limits = self.view.samples.tilt, self.view.config.tilt
            self._slow = tilt >= limits.slow - (limits.hysteresis if self._slow else 0.0)
            self._stop = tilt >= limits.stop - (limits.hysteresis if self._stop else 0.0)

    def reason(self, now: int) -> Iterator[Reason]:
        """Report a tilt above ``tilt.stop``."""
        if self._stop and self.view.samples.attitude_fresh(now):
            yield Reason.TILT_STOP

    def limit(self, now: int, courses: Sequence[Course] | None) -> Iterator[PaceLimit]:
        """Limit the speed above ``tilt.slow``."""
        if self._slow and not self._stop and self.view.samples.attitude_fresh(now):
            yield PaceLimit(Reason.TILT_SLOW, self.view.config.tilt.slow_speed)

    def figures(self, reason: Reason, now: int) -> Iterator[Measurement]:
        """Measured tilt."""
        samples, limit = self.view.samples, self.view.config.tilt.stop
        yield Measurement(name="tilt", value=samples.tilt, unit="rad", limit=limit, age=age(samples.attitude, now))


class BatteryCheck(Check):
    """Slows the robot if the battery is low or its voltage is stale; stops it if the battery is critical.

    Args:
        view: read access to the gate's state.
        measured: whether a device measures the battery.
    """

    reasons = (Reason.BATTERY_CRITICAL, Reason.BATTERY_LOW, Reason.BATTERY_STALE)

    def __init__(self, view: GateView, *, measured: bool) -> None:
        super().__init__(view)
        self._measured = measured

    def reason(self, now: int) -> Iterator[Reason]:
        """Report a critical battery, even after its sensor has become stale."""
        if (battery := self.view.samples.battery) is not None and battery.level is BatteryLevel.CRITICAL:
            yield Reason.BATTERY_CRITICAL

    def limit(self, now: int, courses: Sequence[Course] | None) -> Iterator[PaceLimit]:
        """Limit the speed if the battery is low or its voltage is stale."""
        config, battery = self.view.config, self.view.samples.battery
        if battery is not None and battery.level is BatteryLevel.LOW:
            yield PaceLimit(Reason.BATTERY_LOW, config.battery_low_speed)
        known = self._measured or battery is not None
        if known and not config.battery.critical and not self.view.samples.battery_fresh(now):
            yield PaceLimit(Reason.BATTERY_STALE, config.battery_low_speed)

    def figures(self, reason: Reason, now: int) -> Iterator[Measurement]:
        """Battery voltage."""
        if (battery := self.view.samples.battery) is not None:
            yield Measurement(name="voltage", value=battery.voltage, unit="V", age=age(battery, now))
