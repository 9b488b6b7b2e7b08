"""Decisions of the drive service without its bytes: what a command asks for, what a state means, where the shaft is."""

import math
from typing import NamedTuple

from monstertruck_drivers.epos.config import EposConfig
from monstertruck_drivers.epos.protocol import FAULTED, OFF, State
from monstertruck_runtime.clock import SECOND
from monstertruck_schemas.cmd import DriveAction, DriveCommand
from monstertruck_schemas.sensor import DriveMode

RAD_S_PER_RPM = 2 * math.pi / 60
OVERSPEED = 1.5
"""Times the greatest speed: a shaft cannot have moved faster, so its counter was reset."""


class Wanted(NamedTuple):
    """What the controller shall do: a power state, and the target of ENABLED."""

    goal: State
    rpm: int = 0


def wanted(command: DriveCommand | None, now: int, config: EposConfig) -> Wanted:
    """What the newest command means at ``now``; the host's deadman is here.

    Args:
        command: newest command, if any.
        now: time, ns.
        config: sign, limits and time-outs.

    Returns:
        ENABLED with a target in the controller's own sign, QUICK_STOP, or SWITCH_ON_DISABLED.
    """
    if command is None or command.action is DriveAction.DISABLE:
        return Wanted(State.SWITCH_ON_DISABLED)
    age = (now - command.stamp) / SECOND
    if command.action is DriveAction.QUICK_STOP or age > config.quick_stop_after:
        return Wanted(State.QUICK_STOP)
    if age > config.command_timeout:
        return Wanted(State.ENABLED)
    rpm = round(command.motor_velocity / RAD_S_PER_RPM) * sign(config)
    return Wanted(State.ENABLED, max(-config.max_motor_rpm, min(config.max_motor_rpm, rpm)))


def sign(config: EposConfig) -> int:
    """Controller's sign of driving forward."""
    return -1 if config.inverted else 1


def settled(state: State, goal: State) -> bool:
    """Whether nothing is left to do; a motor that is off needs no quick stop."""
    return state is goal or (goal is State.QUICK_STOP and state in OFF)


def drive_mode(state: State) -> DriveMode:
    """Power state as the robot sees it."""
    if state in FAULTED:
        return DriveMode.FAULT
    if state in OFF:
        return DriveMode.DISABLED
    return {State.ENABLED: DriveMode.ENABLED, State.QUICK_STOP: DriveMode.QUICK_STOP}.get(state, DriveMode.STARTING)


class Odometer:
    """Unwraps the controller's 32-bit position over sessions and restarts of the controller."""

    def __init__(self) -> None:
        self.counts = 0
        """Counts since the daemon started, controller's sign."""
        self._raw: int | None = None
        self._time = 0

    def update(self, raw: int, now: int, fastest: float) -> int:
        """Add the motion since the last reading; a step no motor can make is a counter that was reset.

        Args:
            raw: position of the controller, signed 32 bits.
            now: when it was read, ns.
            fastest: greatest counts per second of the motor.

        Returns:
            ``counts``.
        """
        if self._raw is not None:
            step = (raw - self._raw + 2**31) % 2**32 - 2**31
            if abs(step) <= OVERSPEED * fastest * (now - self._time) / SECOND + 1:
                self.counts += step
        self._raw, self._time = raw, now
        return self.counts

    def restart(self) -> None:
        """The controller was off in between: its next position continues here."""
        self._raw = None
