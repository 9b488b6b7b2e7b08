"""Drive service: runs the EPOS 24/1 in profile velocity mode from ``cmd/drive`` and publishes ``sensor/drive``.

All exchanges share one schedule. The driver checks the latest command before each exchange, so a stop waits no longer
than the exchange in progress. It repeats quick stop and power off after every velocity other than standstill, in case
the controller missed the first one. Every cycle it compares the desired state with the statusword and sends one
controlword that brings the controller a step closer: one loop enables, stops, runs after a quick stop and recovers from
faults.

The controller keeps its last speed when the host goes silent. Every session therefore starts with a quick stop and ends
with a quick stop and the power stage off.
"""

import math
from typing import NamedTuple

from monstertruck_drivers.epos import objects as od
from monstertruck_drivers.epos.config import EposConfig
from monstertruck_drivers.epos.exchange import ATTEMPTS, BRIEF_SILENCES, RECENT, Exchanger, ObjectError, read_identity
from monstertruck_drivers.epos.objects import ObjectEntry
from monstertruck_drivers.epos.protocol import FAULTED, OFF, POWERED, Control, State, next_control, state_of
from monstertruck_drivers.link import Port
from monstertruck_drivers.transaction import Misses
from monstertruck_runtime.clock import SECOND, Clock, Lead, Schedule
from monstertruck_runtime.errors import (
    DeviceError,
    DeviceFaultError,
    DeviceLostError,
    DeviceMismatchError,
    DeviceRestartedError,
    DeviceStoppedError,
    DeviceTimeoutError,
    ProtocolError,
    WrongDeviceError,
)
from monstertruck_runtime.ports import EventSink, Publisher, Ready, Subscription
from monstertruck_schemas.cmd import DriveAction, DriveCommand
from monstertruck_schemas.event import Severity
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.sensor import DriveFeedback, DriveMode

RAD_S_PER_RPM = 2 * math.pi / 60


class Setpoint(NamedTuple):
    """Desired controller state: a power state, and the target speed if ENABLED."""

    goal: State
    rpm: int = 0


def setpoint_of(command: DriveCommand | None, now: int, config: EposConfig) -> Setpoint:
    """Return the set-point for the latest command at ``now``; implements the host-side deadman.

    Args:
        command: latest command, if any.
        now: current time (ns).
        config: sign, limits and timeouts.

    Returns:
        ENABLED with a target in the controller's sign convention, QUICK_STOP, or SWITCH_ON_DISABLED.
    """
    if command is None or command.action is DriveAction.DISABLE:
        return Setpoint(State.SWITCH_ON_DISABLED)
    age = (now - command.stamp) / SECOND
    if command.action is DriveAction.QUICK_STOP or age > config.quick_stop_after:
        return Setpoint(State.QUICK_STOP)
    if age > config.command_timeout:
        return Setpoint(State.ENABLED)
    rpm = round(command.motor_velocity / RAD_S_PER_RPM) * sign(config)
    return Setpoint(State.ENABLED, max(-config.max_motor_rpm, min(config.max_motor_rpm, rpm)))


def sign(config: EposConfig) -> int:
    """Sign of the controller's speed when the truck drives forward."""
    return -1 if config.inverted else 1


def settled(state: State, goal: State) -> bool:
    """Whether ``state`` meets ``goal``; a motor that is off needs no quick stop."""
    return state is goal or (goal is State.QUICK_STOP and state in OFF)


def drive_mode(state: State) -> DriveMode:
    """Power state as reported to the robot."""
    if state in FAULTED:
        return DriveMode.FAULT
    if state in OFF:
        return DriveMode.DISABLED
    return {State.ENABLED: DriveMode.ENABLED, State.QUICK_STOP: DriveMode.QUICK_STOP}.get(state, DriveMode.STARTING)


class Odometer:
    """Unwraps the controller's 32-bit position across sessions and restarts of the controller."""

    def __init__(self) -> None:
        self.counts = 0
        """Counts since the daemon started, controller's sign."""
        self._last: tuple[int, int] | None = None
        """Latest position of the controller, and its time (ns)."""

    def update(self, raw: int, now: int, fastest: float) -> int:
        """Add the motion since the last reading; an impossibly large step means that the counter was reset.

        Args:
            raw: controller position, signed 32-bit.
            now: time of the reading (ns).
            fastest: maximum motor speed (counts/s).

        Returns:
            ``counts``.
        """
        if self._last is not None:
            before, then = self._last
            step = (raw - before + 2**31) % 2**32 - 2**31
            overspeed = 1.5  # factor on the maximum speed: a larger step shows that the counter was reset
            if abs(step) <= overspeed * fastest * (now - then) / SECOND + 1:
                self.counts += step
        self._last = raw, now
        return self.counts

    def restart(self) -> None:
        """Continue from the next position after the controller was off."""
        self._last = None


SAFE_TIME = 0.225
"""Maximum time for stopping and disabling the motor at the end of a session (s), in addition to the duration of the
quick stop; measured from when the controller listens.
"""
SAFE_ATTEMPTS = 2
"""Number of attempts, each limited to ``SAFE_TIME``: the first may collide with the rest of a damaged frame."""
STOPS = {State.QUICK_STOP: Control.QUICK_STOP, State.SWITCH_ON_DISABLED: Control.DISABLE_VOLTAGE}
"""Controlwords that must be sent without delay, by target state."""
SLOW_EXCHANGE = 0.03
"""Median duration of exchanges above which the link is slow (s); at 38400 baud they take 10 to 13 ms."""
QUICK_EXCHANGE = 0.02
"""Median duration at or below which the link is no longer slow (s)."""


class EposDriver:
    """Drive controller service.

    Args:
        config: settings, see ``EposConfig``.
        port: the controller's port.
        clock: time.
        commands: ``cmd/drive``; this driver is the topic's only reader.
        out: ``sensor/drive``, with ``stamp`` in the middle of the exchange that read the position.
        events: event sink for the controller's identity and faults.
        name: service name.
    """

    def __init__(
        self,
        config: EposConfig,
        port: Port,
        clock: Clock,
        commands: Subscription[DriveCommand],
        out: Publisher[DriveFeedback],
        events: EventSink,
        name: str = "drive",
    ) -> None:
        self.name = name
        self.config = config
        self.clock = clock
        self.commands = commands
        self.out = out
        self.events = events
        self.odometer = Odometer()
        self.resets: list[int] = []
        """Times of the fault resets within ``fault_reset_window``."""
        self.reported_fault: int | None = None
        """Reported fault that is still present."""
        self.mark: int | None = None
        """Value of ``od.MARK`` while the controller has not restarted; None if it rejects marks."""
        self._port = port
        self._quiet_until = 0

    async def run(self, ready: Ready) -> None:
        """Run one session, from stopping a motor that may still turn to the stop at its end.

        Raises:
            DeviceLostError: no controller is plugged in, or the link went down.
            DeviceRestartedError: the controller restarted.
            DeviceStoppedError: a motor that should turn was stopped by the deadman line or another master.
            PortBusyError: another process holds the port.
            WrongDeviceError: another device answers.
            DeviceMismatchError: motor or encoder data contradict the configuration.
            DeviceFaultError: resetting does not clear the fault. DeviceTimeoutError, ProtocolError: no usable answers.
        """
        async with await self._port.open() as link:
            line = Exchanger(link, self.clock, self.config.node, self._quiet_until)
            session = _DriveSession(self, line)
            try:
                await session.start()
                await session.serve(ready)
            finally:
                try:
                    if not link.is_lost:
                        await session.make_safe()
                finally:
                    await line.close()
                    self._quiet_until = line.quiet_until


class _DriveSession:
    """One connection: the commands sent and the controller's latest state."""

    def __init__(self, driver: EposDriver, line: Exchanger) -> None:
        self._driver = driver
        self._config = driver.config
        self._clock = driver.clock
        self._line = line
        self._sign = sign(driver.config)
        self._counts_per_turn = 1
        self._state = State.UNKNOWN
        """State from the statusword, updated by later commands."""
        self._reported = State.UNKNOWN
        """State from the statusword."""
        self._doubtful = False
        """Whether an exchange failed, so that the controller may have restarted."""
        self._sent_rpm: int | None = None
        """Target in the controller; None: unknown."""
        self._rpm = 0
        self._current: float | None = None
        self._fault: int | None = None
        self._stopping: State | None = None
        """QUICK_STOP or SWITCH_ON_DISABLED, if currently wanted and its controlword was sent."""
        self._control_sent: Control | None = None
        """Latest controlword from this host."""
        self._prepared = False
        """Whether mode and profile are set as configured."""
        self._commands_after = self._clock.now()
        """Time before which commands are ignored (ns)."""
        self._goal = State.UNKNOWN
        self._goal_since = 0
        self._late_reported = False
        self._slow = False
        self._status_due = 0
        self._current_due = 0
        self._reset_due = 0

    # Begin and end

    async def start(self) -> None:
        """Stop any motion, then identify the device."""
        await self._stop_first()
        await self._line.write(od.TARGET_VELOCITY, 0, ATTEMPTS)
        self._sent_rpm = 0
        identity = await read_identity(self._line)
        identity.check(self._config)
        self._counts_per_turn = identity.counts_per_turn(self._config)
        self._state = self._reported = state_of(await self._line.read(od.STATUSWORD, ATTEMPTS))
        if self._state not in POWERED:
            self._driver.odometer.restart()
        await self._line.shorten_silence()
        await self._check_mark(ATTEMPTS)
        await self._prepare()
        self._report(
            Reason.DEVICE_READY, Severity.INFO, f"EPOS, software 0x{identity.software:04X}", **identity.as_values()
        )

    async def _stop_first(self) -> None:
        try:
            # Retry quickly: a motor that kept its speed during a link loss must rest <= 1.2 s after the link is back.
            handshake_attempts = 2
            await self._line.write(od.CONTROLWORD, Control.QUICK_STOP, handshake_attempts)
        except ObjectError as error:
            if error.code == od.WRONG_NODE:
                raise DeviceMismatchError(f"{error}, configured {self._config.node}") from error
            if error.code != od.WRONG_STATE:
                raise WrongDeviceError(f"not an EPOS 24/1: {error}") from error
        except (DeviceTimeoutError, ProtocolError) as error:
            if self._line.strange and not self._line.acknowledged:
                raise WrongDeviceError(f"not an EPOS, it sends {self._line.strange[:20]!r}: {error}") from error
            raise

    async def _check_mark(self, attempts: int = 1) -> None:
        """Detect a controller restart by the missing mark, and set the mark again.

        Args:
            attempts: maximum attempts for each exchange.

        Raises:
            DeviceRestartedError: it restarted while in use.
        """
        mark = self._driver.mark
        try:
            found = await self._line.read(od.MARK, attempts)
            if found == mark:
                return
            following = od.MARK.decode(found + 1)
            await self._line.write(od.MARK, following, attempts)
            self._driver.mark = following
        except ObjectError:
            return
        if mark is not None:
            self._driver.odometer.restart()
            self._report(Reason.DEVICE_RESTARTED, Severity.WARNING, "the controller restarted: position continues")
            if self._reported not in OFF or self._setpoint().goal is not State.SWITCH_ON_DISABLED:
                raise DeviceRestartedError("the controller restarted")

    async def make_safe(self) -> None:
        """Brake, and switch the power stage off once the motor is at rest.

        Each of the ``SAFE_ATTEMPTS`` attempts times out ``SAFE_TIME`` after the end of a quick stop from full speed.
        The timeout starts once the controller accepts commands again: after a damaged or late answer it needs a pause.
        """
        full_speed = self._config.max_motor_rpm / self._config.quick_stop_deceleration_rpm_s
        # Maximum wait for a quick stop (s), whatever its configured deceleration.
        longest_braking = 1.0
        limit = SAFE_TIME + min(full_speed, longest_braking)
        for _ in range(SAFE_ATTEMPTS):
            try:
                await self._line.finish()
                await self._line.settle()
                async with self._clock.deadline(limit):
                    disable_time = 0.04  # seconds of ``SAFE_TIME`` kept for the last exchange
                    await self._brake_and_switch_off(limit - disable_time)
            except DeviceLostError:
                return
            except (DeviceError, TimeoutError):
                continue
            return

    async def _brake_and_switch_off(self, within: float) -> None:
        """Repeat the quick stop until the motor is at rest or ``within`` seconds have passed, then switch it off.

        A motor still turning after that time ignores quick stops; without its power stage it coasts to rest.
        """
        end = self._clock.now() + int(within * SECOND)
        while self._clock.now() <= end:
            await self._control(Control.QUICK_STOP)
            if abs(await self._line.read(od.VELOCITY)) <= self._config.standstill_rpm:
                break
        await self._control(Control.DISABLE_VOLTAGE)

    # The schedule

    async def serve(self, ready: Ready) -> None:
        """Run cycles until cancelled; a failed exchange is followed by the most urgent one."""
        schedule = Schedule(self._clock, self._config.rate, Lead.POLLING)
        misses, reported_ready = Misses(BRIEF_SILENCES + 2), False  # the last one follows a long silence
        while True:
            with misses:
                await self._cycle()
                self._judge_link()
                if not reported_ready and self._state not in FAULTED:
                    reported_ready = True
                    ready()
                await self._idle(schedule.step())
            if misses.count:
                self._doubtful = True
                await self._line.settle()

    async def _cycle(self) -> None:
        await self._act(also_faster=not self._doubtful)
        if self._doubtful:
            await self._check_mark()
            self._doubtful = self._prepared = False
        _, raw = await self._read_row(od.VELOCITY_AVERAGED, od.POSITION)
        self._publish(raw, (self._line.began + self._line.ended) // 2)
        now = self._clock.now()
        if now >= self._status_due or not settled(self._state, self._setpoint().goal):
            self._status_due = now + int(self._config.status_period * SECOND)
            await self._look()
            await self._step(self._setpoint().goal)
        elif now >= self._current_due:
            self._current_due = now + int(self._config.current_period * SECOND)
            self._current = await self._read(od.CURRENT) / 1000 * self._sign

    def _judge_link(self) -> None:
        """Report a link that has become slow or fast."""
        durations = self._line.durations
        if len(durations) < RECENT:
            return
        median = sorted(durations)[RECENT // 2] / SECOND
        if median > SLOW_EXCHANGE and not self._slow:
            text = f"answers take {median * 1000:.0f} ms: the feedback rate is too low for driving"
            self._report(Reason.SLOW_LINK, Severity.WARNING, text, seconds=median)
        elif median < QUICK_EXCHANGE and self._slow:
            self._report(Reason.SLOW_LINK, Severity.INFO, "answers come quickly again", seconds=median)
        self._slow = median > (QUICK_EXCHANGE if self._slow else SLOW_EXCHANGE)

    async def _idle(self, until: int) -> None:
        """Wait for the next cycle, but execute a stop command immediately."""
        while (left := until - self._clock.now()) > 0:
            if await self._driver.commands.next_within(left / SECOND, lambda _: not self._is_urgent()) is None:
                return
            await self._act()

    async def _read(self, entry: ObjectEntry) -> int:
        return (await self._read_row(entry))[0]

    async def _read_row(self, *entries: ObjectEntry) -> list[int]:
        values: list[int] = []

        def take(value: int) -> bool:
            if entries[len(values)] is od.VELOCITY_AVERAGED:
                self._rpm = value
                if self._moves:
                    self._stopping = None  # the stop is repeated until standstill is measured
            values.append(value)
            return not self._is_urgent()

        while len(values) < len(entries):
            await self._act()
            await self._line.read_row(entries[len(values) :], take)
        return values

    def _publish(self, raw: int, stamp: int) -> None:
        fastest = self._config.max_motor_rpm / 60 * self._counts_per_turn
        counts = self._driver.odometer.update(raw, stamp, fastest)
        self._driver.out.put(
            DriveFeedback(
                stamp=stamp,
                received=self._clock.now(),
                seq=self._driver.out.next_seq(),
                position=self._sign * counts / self._counts_per_turn * 2 * math.pi,
                velocity=self._sign * self._rpm * RAD_S_PER_RPM,
                current=self._current,
                mode=drive_mode(self._state),
                fault_code=self._fault,
            )
        )
        self._current = None

    # Decision

    def _setpoint(self) -> Setpoint:
        """Return the latest valid command's set-point; without one, a moving motor is braked, then switched off."""
        command = self._driver.commands.latest
        if command is not None and command.stamp < self._commands_after:
            command = None
        if command is None and self._state in POWERED and self._moves:
            return Setpoint(State.QUICK_STOP)
        return setpoint_of(command, self._clock.now(), self._config)

    @property
    def _moves(self) -> bool:
        """Whether the latest velocity reading shows that the motor is moving."""
        return abs(self._rpm) > self._config.standstill_rpm

    async def _act(self, *, also_faster: bool = False) -> None:
        """Send urgent commands: quick stop, power stage off, or a lower target.

        ``also_faster``: also send a higher target; this happens only at the start of a cycle.
        """
        setpoint = self._setpoint()
        if setpoint.goal is State.ENABLED:
            self._stopping = None
        elif self._is_urgent_stop(setpoint):
            await self._control(STOPS[setpoint.goal])
            self._stopping = setpoint.goal
            if self._state in POWERED:
                self._state = setpoint.goal
        rpm = self._target(setpoint)
        if rpm != self._sent_rpm and (also_faster or _slower(rpm, self._sent_rpm)):
            self._sent_rpm = None  # if this fails, it is unknown whether it arrived
            await self._line.write(od.TARGET_VELOCITY, rpm)
            self._sent_rpm = rpm

    def _is_urgent(self) -> bool:
        """Whether an urgent command is pending."""
        setpoint = self._setpoint()
        return self._is_urgent_stop(setpoint) or _slower(self._target(setpoint), self._sent_rpm)

    def _is_urgent_stop(self, setpoint: Setpoint) -> bool:
        """Whether a quick stop, or power off for a moving motor, must be sent now."""
        if setpoint.goal is self._stopping or setpoint.goal is State.ENABLED:
            return False
        return setpoint.goal is State.QUICK_STOP or self._moves

    def _target(self, setpoint: Setpoint) -> int:
        return setpoint.rpm if self._state is State.ENABLED else 0

    async def _look(self) -> None:
        """Read the power state and evaluate its changes."""
        was, self._reported = self._reported, state_of(await self._read(od.STATUSWORD))
        self._state = self._reported
        if self._state in OFF and was not in OFF:
            self._prepared = False
            await self._check_mark()
            if was is State.ENABLED and self._control_sent is not Control.DISABLE_VOLTAGE:
                raise DeviceRestartedError("the controller restarted")
        if self._state is State.QUICK_STOP and was is State.ENABLED and self._control_sent is not Control.QUICK_STOP:
            self._judge_foreign_stop()
        if self._state in FAULTED:
            await self._attend_fault()
        elif self._fault is not None:
            self._report(Reason.DEVICE_READY, Severity.INFO, f"fault {od.fault_text(self._fault)} cleared")
            self._fault = None
            self._commands_after = self._clock.now()
        if self._state not in FAULTED:
            self._driver.reported_fault = None

    def _judge_foreign_stop(self) -> None:
        """End the session if the motor should turn: a motor stopped by another client must not restart immediately.

        Raises:
            DeviceStoppedError: the motor was stopped although it should turn.
        """
        if self._setpoint().rpm != 0:
            text = "quick stop not ordered by this program: the deadman line fell, or a second master sends commands"
            self._report(Reason.DEVICE_STOPPED, Severity.WARNING, text)
            raise DeviceStoppedError(text)

    async def _step(self, goal: State) -> None:
        """Send one controlword that moves the state towards ``goal``."""
        now = self._clock.now()
        if goal is not self._goal or settled(self._state, goal) or self._state in FAULTED:
            self._goal, self._goal_since, self._late_reported = goal, now, False
        late = (now - self._goal_since) / SECOND
        goal_limit = 2.0  # seconds of not following commands after which the controller is reported
        if late > goal_limit and not self._late_reported:
            self._late_reported = True
            text = f"controller stays in {self._state.name}, expected {goal.name}"
            self._report(Reason.DEVICE_TIMEOUT, Severity.WARNING, text)
        control = next_control(self._state, goal)
        if control is Control.SHUTDOWN:
            await self._prepare()
        # Seconds after which restarting from a quick stop goes through power stage off.
        reenable_limit = 0.3
        if self._state is State.QUICK_STOP and late > reenable_limit and not self._moves:
            control = Control.DISABLE_VOLTAGE
        if control is not None:
            await self._control(control)

    async def _control(self, control: Control) -> None:
        self._control_sent = control
        try:
            await self._line.write(od.CONTROLWORD, control)
        except ObjectError as error:
            if error.code != od.WRONG_STATE:  # the statusword will show it
                raise

    async def _prepare(self) -> None:
        """Set the mode, limits and ramps, which the controller loses at power-off.

        Raises:
            ProtocolError: the controller rejects the mode.
        """
        if self._prepared:
            return
        await self._line.write(od.MODE, od.PROFILE_VELOCITY, ATTEMPTS)
        mode = await self._line.read(od.MODE_DISPLAY, ATTEMPTS)
        if mode != od.PROFILE_VELOCITY:
            raise ProtocolError(f"mode {mode} instead of {od.PROFILE_VELOCITY} (profile velocity)")
        for entry, value in (
            (od.TARGET_VELOCITY, 0),
            (od.MAX_VELOCITY, self._config.max_motor_rpm),
            (od.ACCELERATION, self._config.acceleration_rpm_s),
            (od.DECELERATION, self._config.deceleration_rpm_s),
            (od.QUICK_STOP_DECELERATION, self._config.quick_stop_deceleration_rpm_s),
        ):
            await self._line.write(entry, value, ATTEMPTS)
        self._sent_rpm = 0
        self._prepared = True

    # Faults

    async def _attend_fault(self) -> None:
        now = self._clock.now()
        if self._fault is None:
            history = await self._history()
            self._fault = history[0] if history else 0
            self._reset_due = now + int(self._config.fault_reset_pause * SECOND)
            if self._fault != self._driver.reported_fault:
                self._driver.reported_fault = self._fault
                text = "history, newest first: " + ", ".join(map(od.fault_text, history))
                self._report(Reason.DRIVE_FAULT, Severity.ERROR, text, code=self._fault)
        elif self._state is State.FAULT and now >= self._reset_due:
            await self._reset_fault(now, self._fault)

    async def _history(self) -> list[int]:
        count = min(await self._read(od.ERROR_COUNT), od.HISTORY_SIZE)
        return [await self._read(entry) & 0xFFFF for entry in od.ERROR_HISTORY[:count]]

    async def _reset_fault(self, now: int, code: int) -> None:
        """Reset a fault once, with an edge on the reset bit.

        Raises:
            DeviceFaultError: there were too many resets recently.
        """
        window = int(self._config.fault_reset_window * SECOND)
        recent = [instant for instant in self._driver.resets if now - instant < window]
        if len(recent) >= self._config.fault_resets:
            raise DeviceFaultError(f"fault {od.fault_text(code)} persists after {len(recent)} resets")
        self._driver.resets = [*recent, now]
        self._reset_due = now + int(self._config.fault_reset_pause * SECOND)
        await self._control(Control.DISABLE_VOLTAGE)
        await self._control(Control.FAULT_RESET)

    def _report(self, reason: Reason, severity: Severity, text: str, **values: float | None) -> None:
        self._driver.events(reason, severity, self._driver.name, text, **values)


def _slower(rpm: int, sent: int | None) -> bool:
    """Whether a target slows the motor down compared with the current one."""
    return sent is None or abs(rpm) < abs(sent) or rpm * sent < 0
