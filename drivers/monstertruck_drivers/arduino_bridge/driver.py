"""Driver for a ROSArduinoBridge board: ``cmd/drive`` and ``cmd/drive_2`` in, encoder counts out.

One exchange per cycle sends the set-points of both motors and reads both counters. The first and the last command of
every session stop the motors. Every set-point also feeds the board's watchdog.
"""

import contextlib
from collections import deque
from collections.abc import Sequence
from typing import NamedTuple, Unpack

from monstertruck_drivers.arduino_bridge.config import ArduinoBridgeConfig
from monstertruck_drivers.arduino_bridge.protocol import pwm, speeds
from monstertruck_drivers.arduino_bridge.session import BoardSession
from monstertruck_drivers.link import Link, Port
from monstertruck_drivers.motors import MotorBoard, ShaftEnds, requested
from monstertruck_runtime.clock import SECOND, Clock
from monstertruck_runtime.errors import DeviceError, DeviceRestartedError
from monstertruck_runtime.ports import EventSink
from monstertruck_schemas.cmd import DriveCommand
from monstertruck_schemas.event import Severity
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.sensor import DriveFeedback, DriveMode

Counts = tuple[int, int]


class BoardSetpoint(NamedTuple):
    """Motor set-points."""

    mode: DriveMode
    command: bytes


def setpoint_of(commands: Sequence[DriveCommand | None], now: int, config: ArduinoBridgeConfig) -> BoardSetpoint:
    """Combine the latest commands of both shafts into set-points; a stale command stops its motor.

    Args:
        commands: latest command for each shaft, if any.
        now: current time (ns).
        config: signs, limits and timeouts.
    """
    mode, known = requested(commands, now, config.command_timeout)
    if mode is DriveMode.DISABLED:
        return BoardSetpoint(mode, pwm(0, 0))
    if mode is DriveMode.QUICK_STOP:
        return BoardSetpoint(mode, speeds(0, 0))
    limit = config.max_rate
    rates = [min(max(command.motor_velocity, -limit), limit) / config.turn / config.pid_rate for command in known]
    left, right = (round(-rate if inverted else rate) for rate, inverted in zip(rates, config.inverted, strict=True))
    return BoardSetpoint(mode, speeds(left, right))


class ArduinoBridgeDriver(MotorBoard[ArduinoBridgeConfig, BoardSession]):
    """Drive service for both motors; see ``MotorBoard``. The topics for third and fourth shafts are unused."""

    def __init__(
        self,
        config: ArduinoBridgeConfig,
        port: Port,
        clock: Clock,
        *,
        events: EventSink,
        name: str = "wheels",
        **ends: Unpack[ShaftEnds],
    ) -> None:
        super().__init__(config, port, clock, 2, events, name, ends)
        self._counts: list[int] = [0, 0]
        """Counts accumulated across sessions and restarts of the board."""
        averaged = (
            4  # number of readings averaged for a speed: one count is a large part of a slow wheel's turn per cycle
        )
        self._readings: deque[tuple[Counts, int]] = deque(maxlen=averaged + 1)
        """Latest counters of this session with their times."""

    def _session(self, link: Link) -> BoardSession:
        return BoardSession(link, self._clock, self._config.answer_timeout)

    async def _start(self, session: BoardSession) -> None:
        """See the base class.

        Raises:
            WrongDeviceError: another device answers.
        """
        self._readings.clear()
        await session.identify(self._config.boot)
        self._events(Reason.DEVICE_READY, Severity.INFO, self.name, "board running ROSArduinoBridge")

    def _setpoint(self) -> BoardSetpoint:
        return setpoint_of(self._latest(), self._clock.now(), self._config)

    def _wanted(self) -> DriveMode:
        return self._setpoint().mode

    async def _exchange(self, session: BoardSession) -> None:
        setpoint = self._setpoint()
        self._sent = setpoint.mode
        counts = await session.exchange(setpoint.command)
        self._take(counts, (session.asked + self._clock.now()) // 2)

    def _take(self, counts: Counts, stamp: int) -> None:
        """Accumulate the encoder counts and publish them.

        Raises:
            DeviceRestartedError: the counters jumped, so the board restarted.
        """
        config = self._config
        if self._readings:
            before, then = self._readings[-1]
            steps = [new - old for old, new in zip(before, counts, strict=True)]
            overspeed = 3.0  # factor on the maximum rate: a larger step shows that the counter was reset
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
            async with self._clock.deadline(0.3):  # seconds allowed at the end of a session to stop the motors
                await session.exchange(speeds(0, 0))
                await session.exchange(pwm(0, 0))
            return
        with contextlib.suppress(DeviceError):
            session.send(b"\r", speeds(0, 0))
