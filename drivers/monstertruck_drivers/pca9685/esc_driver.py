"""Driver for a PCA9685 with a speed controller (ESC) on one of its channels: drives and steers.

The pulse follows every command that the gate sends to the servos, so a stop waits until the next tick. The pulse
becomes neutral when commands are stale and at the start and end of a session. The chip has no watchdog: while the
computer hangs, it repeats the latest pulse. The motor is not measured: the reported rate is the commanded rate, delayed
as configured.
"""

from typing import Unpack

from monstertruck_drivers.esc import UnmeasuredMotor
from monstertruck_drivers.link import Port
from monstertruck_drivers.motors import ShaftEnds
from monstertruck_drivers.pca9685.config import Pca9685EscConfig
from monstertruck_drivers.pca9685.driver import Pca9685Driver
from monstertruck_runtime.clock import Clock
from monstertruck_runtime.errors import ConfigError
from monstertruck_runtime.ports import EventSink, Publisher, Ready, Subscription
from monstertruck_schemas.cmd import SteeringCommand
from monstertruck_schemas.sensor import Battery, DriveFeedback, SteeringFeedback


class Pca9685EscDriver(Pca9685Driver):
    """Sends the speed controller's pulse along with the servo pulses.

    Args:
        config: speed controller and chip settings.
        port: the I2C bus.
        clock: time.
        steering_commands: ``cmd/steering``.
        drive: not used.
        steering: current pulses, as servo angles.
        battery: not used.
        events: chip faults.
        name: service name.
        ends: topics of the shafts; there is one motor, whose rate is published as commanded.
    """

    def __init__(
        self,
        config: Pca9685EscConfig,
        port: Port,
        clock: Clock,
        *,
        steering_commands: Subscription[SteeringCommand],
        drive: Subscription[DriveFeedback],
        steering: Publisher[SteeringFeedback] | None,
        battery: Publisher[Battery] | None,
        events: EventSink,
        name: str = "actuators",
        **ends: Unpack[ShaftEnds],
    ) -> None:
        if steering is None:
            raise ConfigError(f"devices.{name}: another device steers; kind pca9685_esc does it itself")
        super().__init__(config.unit, port, clock, steering_commands, steering, battery, events, name, drive=drive)
        self._esc = config.esc
        self._motor = UnmeasuredMotor(config.esc, clock, ends["commands"], ends["out"], config.command_timeout)

    async def run(self, ready: Ready) -> None:
        """Serve one session. Raises the same errors as ``Pca9685Driver.run``."""
        self._motor.begin()
        await super().run(ready)

    def _more(self, *, rest: bool = False) -> dict[int, int]:
        pulse_us = self._esc.neutral_us if rest else self._motor.pulse_us()
        return {self._esc.channel: self._config.counts(pulse_us)}

    def _restarted(self) -> None:
        self._motor.begin()

    def _polled(self, stamp: int, received: int) -> None:
        self._motor.publish(stamp, received)
