"""Motor behind a speed controller without feedback: the rate to command, and the estimated actual rate."""

import math
from typing import Final

from monstertruck_drivers.servos import EscPulses
from monstertruck_runtime.clock import SECOND, Clock
from monstertruck_runtime.ports import Publisher, Subscription
from monstertruck_schemas.cmd import DriveAction, DriveCommand
from monstertruck_schemas.sensor import DriveFeedback, DriveMode

MODES: Final = {
    DriveAction.RUN: DriveMode.ENABLED,
    DriveAction.QUICK_STOP: DriveMode.QUICK_STOP,
    DriveAction.DISABLE: DriveMode.DISABLED,
}


class UnmeasuredMotor:
    """Follows ``cmd/drive`` and reports the commanded rate, delayed as configured.

    Args:
        esc: speed controller settings.
        clock: time.
        commands: ``cmd/drive``.
        out: ``sensor/drive``.
        command_timeout: age at which a command is stale (s).
    """

    def __init__(
        self,
        esc: EscPulses,
        clock: Clock,
        commands: Subscription[DriveCommand],
        out: Publisher[DriveFeedback],
        command_timeout: float,
    ) -> None:
        self._esc = esc
        self._clock = clock
        self._commands = commands
        self._out = out
        self._timeout = round(command_timeout * SECOND)
        self._ready_at = 0
        """Time when the speed controller has received its neutral pulses (ns)."""
        self._rate = self._turned = 0.0
        """Estimated rate, rad/s, and angle, rad, at ``_at``."""
        self._at = 0

    def begin(self) -> None:
        """Wait for the neutral pulses of a new session."""
        self._ready_at = self._clock.now() + round(self._esc.arming * SECOND)

    def pulse_us(self) -> float:
        """Pulse to send now (us); neutral without a fresh run command."""
        return self._esc.pulse_us(self._wanted(self._clock.now()))

    def _wanted(self, now: int) -> float:
        """Rate to command (rad/s)."""
        command = self._commands.latest
        if command is None or self._mode(now) is not DriveMode.ENABLED or now < self._ready_at:
            return 0.0
        limit = self._esc.max_rate
        return min(max(command.motor_velocity, -limit), limit)

    def _mode(self, now: int) -> DriveMode:
        """Mode of the motor; a stale run command counts as a stop."""
        command = self._commands.latest
        if command is None:
            return DriveMode.DISABLED
        stale = command.action is DriveAction.RUN and now - command.stamp > self._timeout
        return DriveMode.QUICK_STOP if stale else MODES[command.action]

    def publish(self, stamp: int, received: int) -> None:
        """Publish the estimated rate of the motor; publish nothing during the initial neutral pulses."""
        if stamp < self._ready_at:
            return
        wanted = self._wanted(stamp)
        dt = min(max((stamp - self._at) / SECOND, 0.0), 1.0) if self._at else 0.0
        before = self._rate
        slowest = abs(before) - self._esc.quick_deceleration * dt
        slows = before * wanted < 0 or abs(wanted) < slowest
        self._rate = math.copysign(max(slowest, 0.0), before) if slows else wanted
        self._turned += (before + self._rate) / 2 * dt
        self._at = stamp
        self._out.put(
            DriveFeedback(
                stamp=stamp,
                received=received,
                seq=self._out.next_seq(),
                position=self._turned,
                velocity=self._rate,
                mode=self._mode(stamp),
            )
        )
