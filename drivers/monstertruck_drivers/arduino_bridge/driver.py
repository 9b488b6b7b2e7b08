"""Driver of a board that speaks ROSArduinoBridge: ``cmd/drive`` and ``cmd/drive_2`` in, encoder counts out.

One exchange a cycle: the set-points of both motors go out, both counters come back. Both shafts have one state
together: the most careful of their commands counts, and the oldest. The first command of every session stops the
motors, and so does the last one. In between every set-point feeds the board's own watchdog.
"""

import contextlib
from collections import deque
from collections.abc import Sequence
from typing import NamedTuple

from monstertruck_drivers.arduino_bridge.config import ArduinoBridgeConfig
from monstertruck_drivers.arduino_bridge.protocol import pwm, speeds
from monstertruck_drivers.arduino_bridge.session import BoardSession
from monstertruck_drivers.link import Port
from monstertruck_drivers.transaction import Misses
from monstertruck_runtime.clock import POLLING, SECOND, Clock, Schedule
from monstertruck_runtime.errors import DeviceError, DeviceRestartedError
from monstertruck_runtime.ports import EventSink, Publisher, Ready, Subscription
from monstertruck_schemas.cmd import DriveAction, DriveCommand
from monstertruck_schemas.event import Severity
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.sensor import DriveFeedback, DriveMode

Counts = tuple[int, int]


class BoardSetpoint(NamedTuple):
    """Set-points of the motors."""

    mode: DriveMode
    command: bytes


def setpoint_of(commands: Sequence[DriveCommand | None], now: int, config: ArduinoBridgeConfig) -> BoardSetpoint:
    """Combine the latest commands of both shafts into set-points; stale commands stop.

    Args:
        commands: latest command of each shaft, if any.
        now: time, ns.
        config: signs, limits and time-outs.
    """
    known = [command for command in commands if command is not None]
    if len(known) < len(commands) or any(command.action is DriveAction.DISABLE for command in known):
        return BoardSetpoint(DriveMode.DISABLED, pwm(0, 0))
    stale = any(now - command.stamp > config.command_timeout * SECOND for command in known)
    if stale or any(command.action is DriveAction.QUICK_STOP for command in known):
        return BoardSetpoint(DriveMode.QUICK_STOP, speeds(0, 0))
    limit = config.max_rate
    rates = [min(max(command.motor_velocity, -limit), limit) / config.turn / config.pid_rate for command in known]
    left, right = (round(-rate if inverted else rate) for rate, inverted in zip(rates, config.inverted, strict=True))
    return BoardSetpoint(DriveMode.ENABLED, speeds(left, right))


class ArduinoBridgeDriver:
    """Service of both motors.

    Args:
        config: see ``ArduinoBridgeConfig``.
        port: where the board hangs.
        clock: time.
        commands: ``cmd/drive`` of the left shaft.
        commands_2: of the right one.
        commands_3: not used; the board has two motors.
        commands_4: not used.
        out: ``sensor/drive`` of the left shaft, ``stamp`` in the middle of the exchange.
        out_2: of the right one.
        out_3: not used.
        out_4: not used.
        events: identity and restarts.
        name: of the service.
    """

    def __init__(
        self,
        config: ArduinoBridgeConfig,
        port: Port,
        clock: Clock,
        *,
        commands: Subscription[DriveCommand],
        commands_2: Subscription[DriveCommand],
        commands_3: Subscription[DriveCommand],
        commands_4: Subscription[DriveCommand],
        out: Publisher[DriveFeedback],
        out_2: Publisher[DriveFeedback],
        out_3: Publisher[DriveFeedback],
        out_4: Publisher[DriveFeedback],
        events: EventSink,
        name: str = "wheels",
    ) -> None:
        self.name = name
        self._config = config
        self._port = port
        self._clock = clock
        self._commands = (commands, commands_2)
        self._outs = (out, out_2)
        self._events = events
        self._counts: list[int] = [0, 0]
        """Counts accumulated over sessions and restarts of the board."""
        averaged = 4  # readings averaged for a speed: one count is much of a slow wheel's turn per cycle
        self._readings: deque[tuple[Counts, int]] = deque(maxlen=averaged + 1)
        """Latest counters of this session, with their instants."""
        self._sent = DriveMode.DISABLED

    async def run(self, ready: Ready) -> None:
        """One session, from the stop of motors that may still turn to the stop at its end.

        Raises:
            DeviceLostError: nothing plugged in; the link went down.
            DeviceRestartedError: the board restarted while it was in use.
            WrongDeviceError: something else answers.
            PortBusyError: another process holds the port.
            DeviceTimeoutError, ProtocolError: no usable answers.
        """
        async with await self._port.open() as link:
            session = BoardSession(link, self._clock, self._config.answer_timeout)
            self._readings.clear()
            try:
                await session.identify(self._config.boot)
                self._events(Reason.DEVICE_READY, Severity.INFO, self.name, "board with ROSArduinoBridge")
                await self._serve(session, ready)
            finally:
                if not link.is_lost:
                    await self._make_safe(session)

    async def _serve(self, session: BoardSession, ready: Ready) -> None:
        schedule = Schedule(self._clock, self._config.rate, POLLING)
        misses, reported = Misses(), False
        due = 0
        while True:
            if self._clock.now() >= due:
                due = schedule.step()
            await self._until(due)
            setpoint = self._setpoint()
            self._sent = setpoint.mode
            with misses:
                counts = await session.exchange(setpoint.command)
            if misses.count:
                continue
            self._take(counts, (session.asked + self._clock.now()) // 2)
            if not reported:
                reported = True
                ready()

    def _setpoint(self) -> BoardSetpoint:
        return setpoint_of([commands.latest for commands in self._commands], self._clock.now(), self._config)

    def _is_urgent(self) -> bool:
        """Whether a stop is still to be sent."""
        wanted = self._setpoint().mode
        return wanted is not DriveMode.ENABLED and wanted is not self._sent

    async def _until(self, due: int) -> None:
        """Wait for the next cycle, or for a command that stops running motors; the right shaft's is the latest."""
        while (left := due - self._clock.now()) > 0:
            last = self._commands[-1]
            if await last.next_within(left / SECOND, lambda _: not self._is_urgent()) is None or self._is_urgent():
                return

    def _take(self, counts: Counts, stamp: int) -> None:
        """Add up counts and publish.

        Raises:
            DeviceRestartedError: the counters jumped.
        """
        config = self._config
        if self._readings:
            before, then = self._readings[-1]
            steps = [new - old for old, new in zip(before, counts, strict=True)]
            overspeed = 3.0  # times the greatest rate: a shaft cannot have turned faster, so its counter was reset
            most = overspeed * config.max_rate / config.turn * (stamp - then) / SECOND + 1
            if max(map(abs, steps)) > most:
                text = f"{self._port.name}: counters jumped by {steps[0]} and {steps[1]}: the board has restarted"
                self._events(Reason.DEVICE_RESTARTED, Severity.WARNING, self.name, text)
                raise DeviceRestartedError(text)
            self._counts = [turned + step for turned, step in zip(self._counts, steps, strict=True)]
        self._readings.append((counts, stamp))
        (oldest, since), received = self._readings[0], self._clock.now()
        seconds = (stamp - since) / SECOND
        for i, out in enumerate(self._outs):
            sign = (-1 if config.inverted[i] else 1) * config.turn
            out.put(
                DriveFeedback(
                    stamp=stamp,
                    received=received,
                    seq=out.next_seq(),
                    position=sign * self._counts[i],
                    velocity=sign * (counts[i] - oldest[i]) / seconds if seconds else 0.0,
                    mode=self._sent,
                )
            )

    async def _make_safe(self, session: BoardSession) -> None:
        with contextlib.suppress(DeviceError, TimeoutError):
            async with self._clock.deadline(0.3):  # seconds a session may take at its end to stop the motors
                await session.exchange(speeds(0, 0))
                await session.exchange(pwm(0, 0))
            return
        with contextlib.suppress(DeviceError):
            session.send(b"\r", speeds(0, 0))
