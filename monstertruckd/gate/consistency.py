"""Check of sensor consistency: sensors contradicted by other measurements of motion are treated as lost."""

from collections.abc import Iterator, Sequence
from typing import Any, Final

from monstertruck_runtime.clock import SECOND
from monstertruck_schemas.base import Message
from monstertruck_schemas.event import Cause, Measurement
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.roles import DeviceRole
from monstertruck_schemas.state import Consistency, Doubt, DoubtKind
from monstertruck_schemas.topics import CONSISTENCY, Topic
from monstertruckd.gate.checks import Check, GateView, PaceLimit, Tick
from monstertruckd.gate.motion import AHEAD, Course

ENOUGH: Final = 2
"""Number of independent measures of motion that reveal a wrong sensor."""


class ConsistencyCheck(Check):
    """Stops the robot on doubt about a sensor whose silence stops it; slows it if only one sensor measures motion.

    A doubt about motion stops only an armed robot, and only if the doubt arose since arming: arming the robot again
    allows another try.
    """

    reasons = (Reason.SENSORS_DISAGREE, Reason.SENSOR_FROZEN, Reason.UNWITNESSED)
    reads = (CONSISTENCY,)

    def __init__(self, view: GateView) -> None:
        super().__init__(view)
        self._newest: Consistency | None = None
        self._settled = 0
        """Time up to when doubts about motion are ignored, ns."""

    def observe(self, seen: Message | Tick, topic: Topic[Any] | None) -> None:
        """Process the latest comparison; while the robot is disarmed, ignore doubts about its motion."""
        if isinstance(seen, Consistency):
            self._newest = seen
        elif isinstance(seen, Tick) and not self.view.mode.active:
            self._settled = seen.now

    def reason(self, now: int) -> Iterator[Reason]:
        """Report doubts about sensors whose silence stops the robot."""
        doubts = [doubt for doubt in self._doubts() if self._stops(doubt.sensor) and not self._is_expected(doubt)]
        yield from dict.fromkeys(_reason(doubt) for doubt in doubts)

    def limit(self, now: int, courses: Sequence[Course] | None) -> Iterator[PaceLimit]:
        """Limit the speed if the battery voltage is frozen, or if no second measurement confirms the motion."""
        config = self.view.config
        if any(doubt.sensor == DeviceRole.BATTERY for doubt in self._doubts()) and not config.battery.critical:
            yield PaceLimit(Reason.SENSOR_FROZEN, config.battery_low_speed)
        if courses:
            ahead = all(twist[0] >= AHEAD for twist, _ in courses)
            slow = config.unwitnessed * (config.speed if ahead else config.reverse_speed)
            if not self._witnessed(now):
                yield PaceLimit(Reason.UNWITNESSED, slow)
            if any(map(self._is_expected, self._doubts())):
                yield PaceLimit(Reason.SENSORS_DISAGREE, slow)

    def describe(self, reason: Reason, now: int, since: int) -> Iterator[Cause]:
        """One cause per doubt, with both sensors and their difference."""
        found = [doubt for doubt in self._doubts() if _reason(doubt) is reason]
        if not found:
            yield from super().describe(reason, now, since)
        for doubt in found:
            figure = Measurement(name="difference", value=doubt.difference, limit=doubt.limit)
            text = f"{doubt.sensor}: {doubt.text}"
            yield Cause(reason=reason, source=doubt.sensor, since=doubt.since, text=text, measurements=(figure,))

    def text(self, reason: Reason) -> str:
        """Both sensors and their difference, or the missing measurement of motion."""
        if reason is Reason.UNWITNESSED:
            return self._lacking()
        texts = [f"{doubt.sensor}: {doubt.text}" for doubt in self._doubts() if _reason(doubt) is reason]
        return "; ".join(texts) or reason.text

    def _doubts(self) -> Iterator[Doubt]:
        if self._newest is None:
            return
        active = self.view.mode.active
        for doubt in self._newest.doubts:
            if not doubt.kind.lasting or (active and doubt.since > self._settled):
                yield doubt

    def _is_expected(self, doubt: Doubt) -> bool:
        """Return whether a robot armed to calibrate its sensors continues slowly despite this doubt."""
        return self.view.calibrates and _reason(doubt) is Reason.SENSORS_DISAGREE

    def _lacking(self) -> str:
        newest = self._newest
        if newest is None or newest.distances is None:
            return Reason.UNWITNESSED.text
        kinds = (
            ("distance", newest.distances, "a lidar or encoders of free wheels"),
            ("yaw", newest.measures, "a compass, an IMU or a lidar"),
        )
        lacks = [f"{kind} ({cure})" for kind, measures, cure in kinds if len(measures) < ENOUGH]
        return f"no second sensor measures {' and '.join(lacks)}" if lacks else "the comparison of sensors is silent"

    def _witnessed(self, now: int) -> bool:
        newest = self._newest
        if newest is None or now - newest.received > CONSISTENCY.fresh_for() * SECOND:
            return False
        return len(newest.measures) >= ENOUGH

    def _stops(self, sensor: str) -> bool:
        """Return whether the robot stops when this sensor is silent."""
        config = self.view.config
        limits = {
            DeviceRole.LIDAR.value: config.scan,
            DeviceRole.LIDAR_2.value: config.scan,
            DeviceRole.COMPASS.value: config.attitude,
            DeviceRole.DRIVE.value: config.drive,
            DeviceRole.WHEELS.value: config.drive,
            DeviceRole.ACTUATORS.value: config.drive,
            DeviceRole.BATTERY.value: config.battery,
        }
        limit = limits.get(sensor)
        return limit is not None and limit.critical


def _reason(doubt: Doubt) -> Reason:
    return Reason.SENSOR_FROZEN if doubt.kind is DoubtKind.REPEATS else Reason.SENSORS_DISAGREE
