"""Driver of a Maestro with a speed controller (ESC) on one of its channels: drives, steers, measures the battery.

The pulse follows every command that the gate sends to the servos, so a stop waits for the next tick. Stale commands
make it neutral, as do start and end of a session. The unit's serial time-out is the watchdog: it must send this
channel to the neutral pulse. The motor is not measured: the reported rate is the commanded rate, slowed as configured.
"""

import math
from typing import Final

from monstertruck_drivers.link import Port
from monstertruck_drivers.maestro.driver import MaestroDriver
from monstertruck_drivers.maestro.esc_config import MaestroEscConfig
from monstertruck_drivers.maestro.session import MaestroSession
from monstertruck_runtime.clock import SECOND, Clock
from monstertruck_runtime.errors import ConfigError
from monstertruck_runtime.ports import EventSink, Publisher, Ready, Subscription
from monstertruck_schemas.cmd import DriveAction, DriveCommand, SteeringCommand
from monstertruck_schemas.sensor import Battery, DriveFeedback, DriveMode, SteeringFeedback

MODES: Final = {
    DriveAction.RUN: DriveMode.ENABLED,
    DriveAction.QUICK_STOP: DriveMode.QUICK_STOP,
    DriveAction.DISABLE: DriveMode.DISABLED,
}


class MaestroEscDriver(MaestroDriver):
    """Sends the speed controller's pulse along with the servos'.

    Args:
        config: speed controller and unit.
        port: the Maestro's Command Port.
        clock: time.
        commands: ``cmd/drive``.
        commands_2: not used; there is one motor.
        commands_3: not used.
        commands_4: not used.
        steering_commands: ``cmd/steering``.
        drive: this driver's own feedback; it has no current.
        out: ``sensor/drive``: the rate commanded.
        out_2: not used.
        out_3: not used.
        out_4: not used.
        steering: pulses being sent, as servo angles.
        battery: pack voltage; None when the battery is measured elsewhere.
        events: where errors of the device are reported.
        name: of the service.
    """

    def __init__(
        self,
        config: MaestroEscConfig,
        port: Port,
        clock: Clock,
        *,
        commands: Subscription[DriveCommand],
        commands_2: Subscription[DriveCommand],
        commands_3: Subscription[DriveCommand],
        commands_4: Subscription[DriveCommand],
        steering_commands: Subscription[SteeringCommand],
        drive: Subscription[DriveFeedback],
        out: Publisher[DriveFeedback],
        out_2: Publisher[DriveFeedback],
        out_3: Publisher[DriveFeedback],
        out_4: Publisher[DriveFeedback],
        steering: Publisher[SteeringFeedback] | None,
        battery: Publisher[Battery] | None,
        events: EventSink,
        name: str = "actuators",
    ) -> None:
        if steering is None:
            raise ConfigError(f"devices.{name}: another device steers; kind maestro_esc does it itself")
        super().__init__(config.unit, port, clock, steering_commands, steering, battery, events, name, drive=drive)
        self._esc = config.esc
        self._drive_commands = commands
        self._drive_out = out
        self._ready_at = 0
        """When the speed controller has had its neutral pulses, ns."""
        self._rate = self._turned = 0.0
        """Estimated rate, rad/s, and angle, rad, at ``_at``."""
        self._at = 0

    async def run(self, ready: Ready) -> None:
        """Serve one session; raises as ``MaestroDriver.run``."""
        self._ready_at = self._clock.now() + round(self._esc.arming * SECOND)
        await super().run(ready)

    def _more(self, session: MaestroSession, *, rest: bool = False) -> list[bytes]:
        rate = 0.0 if rest else self._wanted(self._clock.now())
        return [session.encode.set_target(self._esc.channel, self._esc.quarters(rate))]

    def _wanted(self, now: int) -> float:
        """Rate to ask for, rad/s."""
        command = self._drive_commands.latest
        fresh = command is not None and now - command.stamp <= self._config.command_timeout * SECOND
        if command is None or not fresh or command.action is not DriveAction.RUN or now < self._ready_at:
            return 0.0
        limit = self._esc.max_rate
        return min(max(command.motor_velocity, -limit), limit)

    def _polled(self, stamp: int, received: int) -> None:
        """Publish the rate that the motor may have: it slows down as configured."""
        wanted, command = self._wanted(stamp), self._drive_commands.latest
        dt = min(max((stamp - self._at) / SECOND, 0.0), 1.0) if self._at else 0.0
        before = self._rate
        slowest = abs(before) - self._esc.quick_deceleration * dt
        slows = before * wanted < 0 or abs(wanted) < slowest
        self._rate = math.copysign(max(slowest, 0.0), before) if slows else wanted
        self._turned += (before + self._rate) / 2 * dt
        self._at = stamp
        self._drive_out.put(
            DriveFeedback(
                stamp=stamp,
                received=received,
                seq=self._drive_out.next_seq(),
                position=self._turned,
                velocity=self._rate,
                mode=DriveMode.DISABLED if command is None else MODES[command.action],
            )
        )
