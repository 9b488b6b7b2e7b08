"""Driver for a Maestro with a speed controller (ESC) on one of its channels: drives, steers, and measures the battery.

The pulse follows every command that the gate sends to the servos, so a stop waits until the next tick. The pulse
becomes neutral when commands are stale and at the start and end of a session. The unit's serial timeout is the
watchdog: it must send this channel to the neutral pulse. The motor is not measured: the reported rate is the commanded
rate, delayed as configured.
"""

from typing import Unpack

from monstertruck_drivers.esc import UnmeasuredMotor
from monstertruck_drivers.link import Port
from monstertruck_drivers.maestro.driver import MaestroDriver
from monstertruck_drivers.maestro.esc_config import MaestroEscConfig
from monstertruck_drivers.maestro.session import MaestroSession
from monstertruck_drivers.motors import ShaftEnds
from monstertruck_runtime.clock import Clock
from monstertruck_runtime.errors import ConfigError
from monstertruck_runtime.ports import EventSink, Publisher, Ready, Subscription
from monstertruck_schemas.cmd import SteeringCommand
from monstertruck_schemas.sensor import Battery, DriveFeedback, SteeringFeedback


class MaestroEscDriver(MaestroDriver):
    """Sends the speed controller's pulse along with the servo pulses.

    Args:
        config: speed controller and Maestro settings.
        port: the Maestro's Command Port.
        clock: time.
        steering_commands: ``cmd/steering``.
        drive: this driver's own feedback; it has no current.
        steering: current pulses, as servo angles.
        battery: pack voltage; None if another device measures the battery.
        events: device errors.
        name: service name.
        ends: topics of the shafts; there is one motor, whose rate is published as commanded.
    """

    def __init__(
        self,
        config: MaestroEscConfig,
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
            raise ConfigError(f"devices.{name}: another device steers; kind maestro_esc does it itself")
        super().__init__(config.unit, port, clock, steering_commands, steering, battery, events, name, drive=drive)
        self._esc = config.esc
        self._motor = UnmeasuredMotor(config.esc, clock, ends["commands"], ends["out"], config.command_timeout)

    async def run(self, ready: Ready) -> None:
        """Serve one session. Raises the same errors as ``MaestroDriver.run``."""
        self._motor.begin()
        await super().run(ready)

    def _more(self, session: MaestroSession, *, rest: bool = False) -> list[bytes]:
        pulse = self._esc.neutral_us if rest else self._motor.pulse_us()
        return [session.encode.set_target(self._esc.channel, round(4 * pulse))]

    def _polled(self, stamp: int, received: int) -> None:
        self._motor.publish(stamp, received)
