"""The check itself."""

from collections.abc import Iterable
from typing import Any

from monstertruck_schemas.base import Message
from monstertruck_schemas.event import Measurement
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.sensor import Imu
from monstertruck_schemas.topics import IMU, Topic
from monstertruckd.gate.checks import Check, GateView, Tick
from truck_bumper.plugin import BumperConfig


class Bumper(Check):
    """Stops the robot after a shock, until it is disarmed."""

    reasons = (Reason.OWN_CHECK,)
    reads = (IMU,)

    def __init__(self, config: BumperConfig, view: GateView) -> None:
        super().__init__(view)
        self._config = config
        self._felt: float | None = None

    def observe(self, seen: Message | Tick, topic: Topic[Any] | None) -> None:
        """Keep a shock."""
        if isinstance(seen, Imu) and abs(seen.linear_acceleration.x) > self._config.shock:
            self._felt = seen.linear_acceleration.x

    def reason(self, now: int) -> Iterable[Reason]:
        """Stop the robot after a shock."""
        if self._felt is not None:
            yield Reason.OWN_CHECK

    def text(self, reason: Reason) -> str:
        """Return the text of the event."""
        return "the bumper felt a shock"

    def figures(self, reason: Reason, now: int) -> Iterable[Measurement]:
        """Yield the acceleration with its limit."""
        if self._felt is not None:
            yield Measurement(name="acceleration", value=self._felt, unit="m/s^2", limit=self._config.shock)

    def reset(self) -> None:
        """Forget the shock."""
        self._felt = None
