"""Drive service of several shafts on one stepper controller: ``cmd/drive*`` in, ``sensor/drive*`` out.

One exchange a cycle: the set-points of all shafts go out, the status comes back and is the feedback of every shaft. The
shafts have one state together: the most careful of their commands counts, and the oldest.

The controller's watchdog stops the motors when the host is silent. The first request of every session is a quick stop,
the last ones are quick stops until the motors rest, and coils off, whether they rest or not.
"""

import contextlib
from collections.abc import Sequence
from typing import Final, NamedTuple

from monstertruck_drivers.link import Port
from monstertruck_drivers.steppers.config import StepperConfig
from monstertruck_drivers.steppers.protocol import Identity, MotorState, RefusalCode, Status, step_of
from monstertruck_drivers.steppers.session import ASK_ATTEMPTS, RequestRefusedByDeviceError, StepperSession
from monstertruck_drivers.transaction import Misses
from monstertruck_runtime.clock import POLLING, SECOND, Clock, Schedule
from monstertruck_runtime.errors import (
    DeviceError,
    DeviceLostError,
    DeviceMismatchError,
    DeviceRestartedError,
    DeviceStoppedError,
    ProtocolError,
)
from monstertruck_runtime.ports import EventSink, Publisher, Ready, Subscription
from monstertruck_schemas.cmd import DriveAction, DriveCommand
from monstertruck_schemas.event import Severity
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.sensor import DriveFeedback, DriveMode

SAFE_DEADLINE: Final = 0.4
"""Seconds a session may take at its end to stop the motors and switch them off."""

MODES: Final = {
    MotorState.OFF: DriveMode.DISABLED,
    MotorState.RUN: DriveMode.ENABLED,
    MotorState.STOPPED: DriveMode.QUICK_STOP,
    MotorState.WATCHDOG: DriveMode.QUICK_STOP,
}


class MotorSetpoints(NamedTuple):
    """Set-points of the motors."""

    state: MotorState
    rates: tuple[int, ...] = ()
    """1/1000 step/s, in the controller's own sign; of RUN."""


def setpoint_of(commands: Sequence[DriveCommand | None], now: int, config: StepperConfig) -> MotorSetpoints:
    """Combine the latest commands of all shafts into set-points; implements the host's deadman.

    Args:
        commands: latest command of every shaft, if any.
        now: time, ns.
        config: signs, limits and time-outs.
    """
    known = [command for command in commands if command is not None]
    if len(known) < len(commands) or any(command.action is DriveAction.DISABLE for command in known):
        return MotorSetpoints(MotorState.OFF)
    age = max(now - command.stamp for command in known) / SECOND
    if age > config.quick_stop_after or any(command.action is DriveAction.QUICK_STOP for command in known):
        return MotorSetpoints(MotorState.STOPPED)
    if age > config.command_timeout:
        return MotorSetpoints(MotorState.RUN, (0,) * len(known))
    limit = config.max_rate
    steps = [min(max(command.motor_velocity / config.turn, -limit), limit) for command in known]
    rates = [-rate if inverted else rate for rate, inverted in zip(steps, config.inverted, strict=False)]
    return MotorSetpoints(MotorState.RUN, tuple(round(1000 * rate) for rate in rates))


class StepperDriver:
    """Service of all motors on one controller.

    Args:
        config: see ``StepperConfig``.
        port: port of the controller.
        clock: time.
        commands: ``cmd/drive`` of the first shaft.
        commands_2: the same for the second shaft.
        commands_3: the same for the third shaft.
        commands_4: the same for the fourth shaft.
        out: ``sensor/drive`` of the first shaft, ``stamp`` in the middle of the exchange.
        out_2: the same for the second shaft.
        out_3: the same for the third shaft.
        out_4: the same for the fourth shaft.
        events: identity, restarts, a noisy line.
        name: name of the service.
    """

    def __init__(
        self,
        config: StepperConfig,
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
        self._commands = (commands, commands_2, commands_3, commands_4)[: config.motors]
        self._outs = (out, out_2, out_3, out_4)[: config.motors]
        self._events = events
        self._steps = [0] * config.motors
        """Counted over sessions and restarts of the controller."""
        self._last: tuple[Status, int] | None = None
        """Latest status and its arrival time."""
        self._asked = MotorState.OFF
        """State last requested from the controller."""

    async def run(self, ready: Ready) -> None:
        """One session, from the stop of motors that may still turn to the stop at its end.

        Raises:
            DeviceLostError: nothing plugged in; the link went down.
            DeviceRestartedError: the controller restarted while it was in use.
            DeviceStoppedError: its watchdog stopped motors that were to turn.
            DeviceMismatchError: motors or steps per turn are not those configured.
            WrongDeviceError: something else answers.
            PortBusyError: another process holds the port.
            DeviceTimeoutError, ProtocolError: no usable answers.
        """
        async with await self._port.open() as link:
            session = StepperSession(link, self._clock, self._config.answer_timeout)
            try:
                motors = (await self._start(session)).motors
                await self._serve(session, motors, ready)
            finally:
                if not link.is_lost:
                    await self._make_safe(session)

    async def _start(self, session: StepperSession) -> Identity:
        config = self._config
        session.send("Q")
        identity = await session.identify()
        if identity.motors < config.motors or identity.steps_per_turn != config.steps_per_turn:
            raise DeviceMismatchError(
                f"{self._port.name}: {identity.motors} motors of {identity.steps_per_turn} steps, configured are "
                f"{config.motors} of {config.steps_per_turn}"
            )
        if self._last is not None and len(self._last[0].positions) != identity.motors:
            self._last = None  # another controller is plugged in
        began = self._clock.now()
        while any((await session.status("Q", identity.motors, attempts=ASK_ATTEMPTS)).rates):
            if self._clock.now() - began > SAFE_DEADLINE * SECOND:
                raise ProtocolError(f"{self._port.name}: the motors do not come to rest")
            await self._clock.sleep(1.0 / config.rate)
        settings = (config.acceleration, config.quick_deceleration, round(1000 * config.watchdog))
        taken = await session.ask("C", *settings, attempts=ASK_ATTEMPTS)
        if taken.words != tuple(map(str, settings)):
            raise ProtocolError(f"{self._port.name}: settings {settings} were taken as {' '.join(taken.words)}")
        text = f"{identity.name} version {identity.version}, {identity.motors} motors"
        self._events(Reason.DEVICE_READY, Severity.INFO, self.name, text)
        return identity

    async def _serve(self, session: StepperSession, motors: int, ready: Ready) -> None:
        schedule = Schedule(self._clock, self._config.rate, POLLING)
        misses, reported = Misses(), False
        noise, noted = session.splitter.bad, self._clock.now()
        due = 0
        while True:
            if self._clock.now() >= due:
                due = schedule.step()
            await self._until(due)
            setpoint = self._setpoint()
            with misses:
                status = await self._exchange(session, motors, setpoint)
            if misses.count:
                continue
            self._publish(status, session)
            if not reported:
                reported = True
                ready()
            noise_window = 10 * SECOND
            if self._clock.now() - noted > noise_window:
                noise, noted = session.splitter.bad, self._clock.now()
            elif session.splitter.bad - noise >= 5:  # damaged lines within ``noise_window`` that are reported
                text = f"{session.splitter.bad - noise} damaged lines, newest {session.splitter.strange!r}"
                self._events(Reason.DEVICE_PROTOCOL, Severity.WARNING, self.name, text)
                noise = session.splitter.bad

    def _setpoint(self) -> MotorSetpoints:
        return setpoint_of([commands.latest for commands in self._commands], self._clock.now(), self._config)

    def _is_urgent(self) -> bool:
        """Whether a stop, or switching off the current, is still to be sent to the motors."""
        wanted = self._setpoint().state
        return wanted is not MotorState.RUN and wanted is not self._asked

    async def _until(self, due: int) -> None:
        """Wait for the next cycle, or for a command that stops running motors; the last shaft's is the latest."""
        while (left := due - self._clock.now()) > 0:
            last = self._commands[-1]
            if await last.next_within(left / SECOND, lambda _: not self._is_urgent()) is None or self._is_urgent():
                return

    async def _exchange(self, session: StepperSession, motors: int, setpoint: MotorSetpoints) -> Status:
        self._asked = setpoint.state
        if setpoint.state is MotorState.OFF:
            status = await session.status("D", motors)
        elif setpoint.state is MotorState.STOPPED:
            status = await session.status("Q", motors)
        else:
            try:
                status = await session.status("R", motors, *setpoint.rates, *(0,) * (motors - len(setpoint.rates)))
            except RequestRefusedByDeviceError as error:
                if error.code == RefusalCode.TRIPPED:
                    text = f"{self._port.name}: the controller's watchdog stopped the motors"
                    raise DeviceStoppedError(text) from error
                raise
        self._check(status)
        return status

    def _check(self, status: Status) -> None:
        """Notice a controller that restarted.

        Raises:
            DeviceRestartedError: it did, while it was in use.
        """
        now = self._clock.now()
        uptime_slack = 200  # tolerated lag of the controller's uptime behind the host's time between two answers (ms)
        if self._last is not None:
            before, then = self._last
            passed = (status.uptime_ms - before.uptime_ms) % (1 << 32)
            elapsed = (now - then) / 1e6
            if not -uptime_slack <= passed - elapsed <= uptime_slack + elapsed:
                self._last = None
                self._events(Reason.DEVICE_RESTARTED, Severity.WARNING, self.name, "the controller restarted")
                if before.state is not MotorState.OFF:
                    raise DeviceRestartedError(f"{self._port.name}: the controller restarted")

    def _publish(self, status: Status, session: StepperSession) -> None:
        now = self._clock.now()
        if self._last is not None:
            before = self._last[0].positions
            for i, (old, new) in enumerate(zip(before, status.positions, strict=True)):
                if i < len(self._steps):
                    self._steps[i] += step_of(old, new)
        self._last = status, now
        for i, out in enumerate(self._outs):
            sign = -1.0 if self._config.inverted[i] else 1.0
            out.put(
                DriveFeedback(
                    stamp=(session.asked + now) // 2,
                    received=now,
                    seq=out.next_seq(),
                    position=sign * self._steps[i] * self._config.turn,
                    velocity=sign * status.rates[i] / 1000 * self._config.turn,
                    mode=MODES[status.state],
                )
            )

    async def _make_safe(self, session: StepperSession) -> None:
        with contextlib.suppress(DeviceError, TimeoutError):
            async with self._clock.deadline(SAFE_DEADLINE):
                motors = (await session.identify()).motors if self._last is None else len(self._last[0].positions)
                end = self._clock.now() + round((SAFE_DEADLINE - ASK_ATTEMPTS * self._config.answer_timeout) * SECOND)
                while any((await session.status("Q", motors, attempts=ASK_ATTEMPTS)).rates) and self._clock.now() < end:
                    await self._clock.sleep(0.02)
                await session.status("D", motors, attempts=ASK_ATTEMPTS)
            return
        with contextlib.suppress(DeviceLostError):
            session.send("Q")
