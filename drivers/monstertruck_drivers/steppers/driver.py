"""Drive service for several shafts on one stepper controller: ``cmd/drive*`` in, ``sensor/drive*`` out.

One exchange per cycle sends the set-points of all shafts and receives the status, which is the feedback of every shaft.

The controller's watchdog stops the motors when the host is silent. Every session starts with a quick stop. It ends with
quick stops until the motors are at rest or a timeout expires, and then switches the coils off.
"""

import contextlib
from collections.abc import Sequence
from typing import Final, NamedTuple, Unpack

from monstertruck_drivers.link import Link, Port
from monstertruck_drivers.motors import MotorBoard, ShaftEnds, requested
from monstertruck_drivers.steppers.config import StepperConfig
from monstertruck_drivers.steppers.protocol import MotorState, RefusalCode, Status, step_of
from monstertruck_drivers.steppers.session import ASK_ATTEMPTS, RequestRefusedByDeviceError, StepperSession
from monstertruck_runtime.clock import SECOND, Clock
from monstertruck_runtime.errors import (
    DeviceError,
    DeviceLostError,
    DeviceMismatchError,
    DeviceRestartedError,
    DeviceStoppedError,
    ProtocolError,
)
from monstertruck_runtime.ports import EventSink
from monstertruck_schemas.cmd import DriveCommand
from monstertruck_schemas.event import Severity
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.sensor import DriveFeedback, DriveMode

SAFE_DEADLINE: Final = 0.4
"""Maximum time for stopping the motors and switching them off at the end of a session (s)."""

MODES: Final = {
    MotorState.OFF: DriveMode.DISABLED,
    MotorState.RUN: DriveMode.ENABLED,
    MotorState.STOPPED: DriveMode.QUICK_STOP,
    MotorState.WATCHDOG: DriveMode.QUICK_STOP,
}


class MotorSetpoints(NamedTuple):
    """Motor set-points."""

    state: MotorState
    rates: tuple[int, ...] = ()
    """Rates for RUN (1/1000 step/s), in the controller's own sign."""


def setpoint_of(commands: Sequence[DriveCommand | None], now: int, config: StepperConfig) -> MotorSetpoints:
    """Combine the latest commands of all shafts into set-points; implements the host-side deadman.

    Args:
        commands: latest command for every shaft, if any.
        now: current time (ns).
        config: signs, limits and timeouts.
    """
    mode, known = requested(commands, now, config.quick_stop_after)
    if mode is not DriveMode.ENABLED:
        return MotorSetpoints(MotorState.OFF if mode is DriveMode.DISABLED else MotorState.STOPPED)
    if any(now - command.stamp > config.command_timeout * SECOND for command in known):
        return MotorSetpoints(MotorState.RUN, (0,) * len(known))
    limit = config.max_rate
    steps = [min(max(command.motor_velocity / config.turn, -limit), limit) for command in known]
    rates = [-rate if inverted else rate for rate, inverted in zip(steps, config.inverted, strict=False)]
    return MotorSetpoints(MotorState.RUN, tuple(round(1000 * rate) for rate in rates))


class StepperDriver(MotorBoard[StepperConfig, StepperSession]):
    """Drive service for all motors on one controller; see ``MotorBoard``."""

    def __init__(
        self,
        config: StepperConfig,
        port: Port,
        clock: Clock,
        *,
        events: EventSink,
        name: str = "wheels",
        **ends: Unpack[ShaftEnds],
    ) -> None:
        super().__init__(config, port, clock, config.motors, events, name, ends)
        self._motors = config.motors
        """Number of motors of the controller."""
        self._steps = [0] * config.motors
        """Steps accumulated across sessions and restarts of the controller."""
        self._last: tuple[Status, int] | None = None
        """Latest status and its arrival time."""
        self._noise, self._noted = 0, 0
        """Number of damaged lines at the start of the current window, and the start time (ns)."""

    def _session(self, link: Link) -> StepperSession:
        return StepperSession(link, self._clock, self._config.answer_timeout)

    async def _start(self, session: StepperSession) -> None:
        """See the base class.

        Raises:
            DeviceMismatchError: the number of motors or the steps per turn differ from the configuration.
            WrongDeviceError: another device answers.
        """
        config = self._config
        session.send("Q")
        identity = await session.identify()
        if identity.motors < config.motors or identity.steps_per_turn != config.steps_per_turn:
            raise DeviceMismatchError(
                f"{self._port.name}: {identity.motors} motors with {identity.steps_per_turn} steps, "
                f"expected {config.motors} with {config.steps_per_turn}"
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
            raise ProtocolError(f"{self._port.name}: settings {settings} were applied as {' '.join(taken.words)}")
        text = f"{identity.name} version {identity.version}, {identity.motors} motors"
        self._events(Reason.DEVICE_READY, Severity.INFO, self.name, text)
        self._motors = identity.motors
        self._noise, self._noted = session.splitter.bad, self._clock.now()

    def _setpoint(self) -> MotorSetpoints:
        return setpoint_of(self._latest(), self._clock.now(), self._config)

    def _wanted(self) -> DriveMode:
        return MODES[self._setpoint().state]

    async def _exchange(self, session: StepperSession) -> None:
        """See the base class.

        Raises:
            DeviceRestartedError: the controller restarted while in use.
            DeviceStoppedError: the controller's watchdog stopped motors that should turn.
        """
        setpoint = self._setpoint()
        self._sent = MODES[setpoint.state]
        status = await self._ask(session, setpoint)
        self._check(status)
        self._publish(status, session)
        self._report_noise(session)

    async def _ask(self, session: StepperSession, setpoint: MotorSetpoints) -> Status:
        motors = self._motors
        if setpoint.state is MotorState.OFF:
            return await session.status("D", motors)
        if setpoint.state is MotorState.STOPPED:
            return await session.status("Q", motors)
        try:
            return await session.status("R", motors, *setpoint.rates, *(0,) * (motors - len(setpoint.rates)))
        except RequestRefusedByDeviceError as error:
            if error.code == RefusalCode.TRIPPED:
                text = f"{self._port.name}: the controller's watchdog stopped the motors"
                raise DeviceStoppedError(text) from error
            raise

    def _report_noise(self, session: StepperSession) -> None:
        noise_window = 10 * SECOND
        splitter = session.splitter
        if self._clock.now() - self._noted > noise_window:
            self._noise, self._noted = splitter.bad, self._clock.now()
        elif splitter.bad - self._noise >= 5:  # damaged lines within ``noise_window`` that are reported
            text = f"{splitter.bad - self._noise} damaged lines, latest {splitter.strange!r}"
            self._events(Reason.DEVICE_PROTOCOL, Severity.WARNING, self.name, text)
            self._noise = splitter.bad

    def _check(self, status: Status) -> None:
        """Detect a restart of the controller.

        Raises:
            DeviceRestartedError: the controller restarted while in use.
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
