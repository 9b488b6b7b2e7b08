"""The figures behind the gate's reasons, looked up only when the truck is stopped or an order refused."""

from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Final

from monstertruck_runtime.clock import SECOND
from monstertruck_schemas.base import Message
from monstertruck_schemas.event import Cause, Measurement
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import ControlRequest
from monstertruck_schemas.sensor import DriveMode
from monstertruckd.gate.config import GateConfig
from monstertruckd.gate.pursuit import Pursuit
from monstertruckd.gate.sources import Source
from monstertruckd.gate.steering_check import SteeringCheck
from monstertruckd.gate.watch import STALE_SENSORS, Watch

GATE: Final = "gate"
"""Source of what only the gate itself knows."""


class Evidence:
    """Turns reasons into causes with measurements.

    Args:
        config: limits.
        watch: newest samples.
        pursuit: what lies ahead.
        check: compass against steering; None = not checked.
    """

    def __init__(self, config: GateConfig, watch: Watch, pursuit: Pursuit, check: SteeringCheck | None) -> None:
        self._config = config
        self._watch = watch
        self._pursuit = pursuit
        self._check = check
        self.pause = 0.0
        """Greatest pause between two ticks of late, s."""
        self._figures: Mapping[Reason, Callable[[int], Iterator[Measurement]]] = {
            Reason.DRIVE_FAULT: self._fault,
            Reason.TILT_STOP: self._tilt,
            Reason.BATTERY_CRITICAL: self._voltage,
            Reason.TICK_STALLED: self._stall,
            Reason.STEERING_DEAD: self._turn,
            Reason.OBSTACLE_STOP: self._obstacle,
        }

    def causes(self, reasons: Iterable[Reason], now: int, since: Mapping[Reason, int]) -> list[Cause]:
        """One cause per reason, and one per failed service.

        Args:
            reasons: worst first.
            now: ns.
            since: when the gate first saw each of them.
        """
        causes = []
        for reason in reasons:
            began = since.get(reason, now)
            if reason is Reason.SERVICE_FAILED:
                causes += [
                    Cause(reason=reason, source=name, since=began, text=f"{reason.text}: {name}")
                    for name in self._watch.failed
                ]
            elif reason in STALE_SENSORS:
                causes.append(self._silence(reason, now, began))
            else:
                figures = tuple(self._figures.get(reason, _none)(now))
                causes.append(Cause(reason=reason, source=GATE, since=began, text=reason.text, measurements=figures))
        return causes

    def lease(self, source: Source, now: int) -> Cause:
        """The cause of a stop for want of requests."""
        request = source.request
        figures = [
            Measurement(
                name="silence",
                value=(now - source.arrived) / SECOND,
                unit="s",
                limit=(source.deadline - source.arrived) / SECOND,
            )
        ]
        if not source.inside and request.gate_stamp is not None:
            # From the gate's state its sender had seen to the request's arrival: both ways, and the sender's waiting.
            figures.append(
                Measurement(name="last round trip", value=(source.arrived - request.gate_stamp) / SECOND, unit="s")
            )
        return Cause(
            reason=Reason.LEASE_EXPIRED,
            source=request.source,
            since=min(source.deadline, now),
            text=f"lease of {request.source} expired",
            measurements=tuple(figures),
        )

    def _silence(self, reason: Reason, now: int, began: int) -> Cause:
        silence = self._watch.silence(reason, now)
        figures = [Measurement(name="age", value=silence.age, unit="s", limit=silence.limit)]
        if silence.refused is not None:
            figures.append(silence.refused)
        return Cause(
            reason=reason,
            source=STALE_SENSORS[reason],
            since=began if silence.since is None else silence.since,
            text=reason.text,
            measurements=tuple(figures),
        )

    def _fault(self, now: int) -> Iterator[Measurement]:
        for drive in self._watch.drives:
            if drive is not None and drive.mode is DriveMode.FAULT:
                code = drive.fault_code
                yield Measurement(name="fault code", value=None if code is None else float(code), age=_age(drive, now))

    def _tilt(self, now: int) -> Iterator[Measurement]:
        attitude, limit = self._watch.attitude, self._config.tilt.stop
        yield Measurement(name="tilt", value=self._watch.tilt, unit="rad", limit=limit, age=_age(attitude, now))

    def _voltage(self, now: int) -> Iterator[Measurement]:
        battery = self._watch.battery
        if battery is not None:
            yield Measurement(name="voltage", value=battery.voltage, unit="V", age=_age(battery, now))

    def _stall(self, _now: int) -> Iterator[Measurement]:
        yield Measurement(name="pause", value=self.pause, unit="s", limit=self._config.tick_stall)

    def _turn(self, _now: int) -> Iterator[Measurement]:
        if self._check is not None and self._config.turning is not None:
            limit = self._config.turning.tolerance
            yield Measurement(name="turned otherwise by", value=self._check.difference, unit="rad", limit=limit)

    def _obstacle(self, now: int) -> Iterator[Measurement]:
        age = _age(self._watch.scan, now)
        keep = self._config.obstacle.ahead
        yield Measurement(name="free way", value=self._pursuit.free, unit="m", limit=keep, age=age)


def order_cause(reason: Reason, text: str, request: ControlRequest, now: int) -> Cause:
    """The cause of a stop that somebody asked for."""
    return Cause(reason=reason, source=request.source, since=now, text=text)


def _age(message: Message | None, now: int) -> float | None:
    return None if message is None else (now - message.received) / SECOND


def _none(_now: int) -> Iterator[Measurement]:
    return iter(())
