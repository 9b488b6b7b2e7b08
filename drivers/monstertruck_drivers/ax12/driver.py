"""Stabiliser driver: sends joint goals; reads angles, loads, temperatures and alarms of both servos."""

import contextlib
from typing import Final

from monstertruck_drivers.ax12 import protocol as p
from monstertruck_drivers.ax12.config import Ax12Config, JointConfig
from monstertruck_drivers.ax12.protocol import Alarm, Present, alarm_names, word
from monstertruck_drivers.ax12.session import RETRIES, Ax12Session
from monstertruck_drivers.link import Port
from monstertruck_runtime.clock import SECOND, Clock, Lead, Schedule
from monstertruck_runtime.errors import DeviceMismatchError, DeviceTimeoutError, ProtocolError, WrongDeviceError
from monstertruck_runtime.ports import EventSink, Publisher, Ready, Subscription, Value
from monstertruck_schemas.event import Severity
from monstertruck_schemas.plan import StabiliserCommand
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.sensor import StabiliserFeedback, StabiliserJoint, TorqueState

STORED: Final = 19
"""Bytes of settings from the start of the control table."""
ANSWERS_ALL: Final = b"\x02"
"""Status return level at which units also answer writes."""


class Joint:
    """Keeps one unit at its goal; only ``join`` and ``poll`` wait for the bus.

    **Alarms.** An overloaded or overheated unit sets its torque limit to 0 and goes limp. It still answers, and its
    error bits may clear although it stays limp. The driver therefore reads the torque settings at intervals and
    whenever the bits change. After a waiting time, once the unit is cool, the driver switches its torque on; it first
    sets the goal to the current position, so that the unit does not jump.

    **Motion without a goal.** A load pushes a joint away from its goal against the unit's torque. A unit that moves
    away from its goal in the direction of its own torque does not obey: the driver removes its torque.

    Args:
        name: ``pitch`` or ``roll``.
        joint: calibration.
        config: timing and limits.
        clock: time source.
        events: alarms, and the unit going silent or answering again.
        source: service name.
    """

    def __init__(
        self, name: str, joint: JointConfig, config: Ax12Config, clock: Clock, events: EventSink, source: str
    ) -> None:
        self.id = joint.id
        self.torque = TorqueState.ABSENT
        self._name = name
        self._joint = joint
        self._config = config
        self._clock = clock
        self._events = events
        self._source = source
        self._rest = config.alarm.rest
        self._held_at: int | None = None
        self._strays = 0
        """Number of times the unit drove itself away from its goal."""
        self.forget()

    def forget(self) -> None:
        """Reset the unit's state at the start of a session; a waiting time after an alarm continues."""
        self.torque = TorqueState.ABSENT
        self._present: Present | None = None
        self._error = Alarm(0)
        self._reported = Alarm(0)
        self._clean_since = self._clock.now()
        self._misses = 0
        self._ask_at = 0
        self._check_at = 0
        self._hold_at = 0
        self._max_torque = p.MAX_TORQUE.default
        self._outage = False
        self._goal: int | None = None
        """Latest goal sent (steps)."""
        self._straying = 0
        """Number of consecutive readings in which the unit drove itself away from its goal."""

    # Known state

    @property
    def angle(self) -> float | None:
        """Joint angle (rad); None while the unit does not answer."""
        return None if self._present is None else self._joint.angle(self._present.position)

    def goal(self, angle: float) -> bytes:
        """Set the goal to a joint angle (rad), clamped to the limits; return the bytes for the goal register."""
        self._goal = self._joint.position(angle)
        return p.GOAL_POSITION.encode(self._goal)

    def feedback(self) -> StabiliserJoint:
        """Feedback for the message, with the sign of the joint angle."""
        present = self._present
        if present is None:
            return StabiliserJoint(torque=self.torque, strays=self._strays)
        sign = self._joint.direction
        return StabiliserJoint(
            torque=self.torque,
            error=int(self._error),
            velocity=sign * present.speed * p.SPEED_UNIT,
            load=sign * present.load * p.LOAD_UNIT,
            voltage=present.voltage * p.VOLT_UNIT,
            temperature=float(present.temperature),
            strays=self._strays,
        )

    # Exchanges

    async def join(self, session: Ax12Session, retries: int = RETRIES) -> None:
        """Check that the unit is present and matches the configuration; the next ``poll`` makes it hold its position.

        Raises:
            DeviceLostError: the adapter was unplugged.
            DeviceTimeoutError: the unit does not answer.
            ProtocolError: the unit refuses.
            WrongDeviceError: the unit is not an AX-12A.
            DeviceMismatchError: the unit is in endless-turn mode, or its limits exclude configured goals.
        """
        self._ask_at = self._clock.now() + round(self._config.absent_interval * SECOND)
        await session.ping(self.id, retries)
        try:
            stored = (await session.read(self.id, p.MODEL_NUMBER, STORED, retries)).data
        except DeviceTimeoutError:
            await self._answer_all(session)
            stored = (await session.read(self.id, p.MODEL_NUMBER, STORED, retries)).data
        self._check(stored)
        if stored[p.STATUS_LEVEL.address] != ANSWERS_ALL[0]:
            await self._answer_all(session)
        self._max_torque = word(stored, p.MAX_TORQUE.address)
        self._misses = 0
        self.torque = TorqueState.LIMP
        self._hold_at = 0

    async def poll(self, session: Ax12Session) -> None:
        """Read the unit and act on its state.

        Raises:
            DeviceLostError: the adapter was unplugged.
            WrongDeviceError: the unit was replaced by another model.
            DeviceMismatchError: its settings do not match.
        """
        try:
            if self.torque is TorqueState.ABSENT:
                if self._clock.now() < self._ask_at:
                    return
                await self.join(session, retries=0)
            answer = await session.read(self.id, p.PRESENT_POSITION, p.PRESENT_SIZE, retries=0)
            self._misses = 0
            before, self._present = self._present, Present.decode(answer.data)
            if before is not None and self._is_straying(before, self._present):
                await self._stop_straying(session, self._present)
            else:
                await self._look_after(session, self._present, answer.error)
        except (DeviceTimeoutError, ProtocolError) as error:
            self._miss(str(error))

    def _is_straying(self, before: Present, present: Present) -> bool:
        """Whether the unit drove itself away from its goal in three consecutive readings."""
        if self.torque is not TorqueState.HOLDING or self._goal is None:
            self._straying = 0
            return False
        gap, gap_before = present.position - self._goal, before.position - self._goal
        driven = present.load * gap > 0 and abs(gap) > max(abs(gap_before), self._config.margin)
        self._straying = self._straying + 1 if driven else 0
        strays = 3  # number of such readings after which the unit loses its torque
        return self._straying >= strays

    async def _stop_straying(self, session: Ax12Session, present: Present) -> None:
        """Switch the torque off for a waiting time, and read it back: a late answer may belong to an earlier write.

        Raises:
            DeviceTimeoutError, ProtocolError: the unit does not confirm torque off; the next reading repeats it.
        """
        await session.write(self.id, p.TORQUE_ENABLE, b"\x00")
        enabled, *_ = await self._settings(session, RETRIES)
        if enabled:
            raise ProtocolError(f"unit {self.id} ({self._name}) keeps its torque")
        self._straying, rest = 0, self._begin_rest()
        self._strays += 1
        text = f"moved to {present.position} by itself, its goal is {self._goal}: torque off for {rest:g} s"
        self._report(Reason.UNCOMMANDED_MOTION, Severity.ERROR, text, position=present.position, goal=self._goal)

    async def _look_after(self, session: Ax12Session, present: Present, error: Alarm) -> None:
        now = self._clock.now()
        changed, self._error = error != self._error, error
        self._report_alarms(error, now)
        if self.torque is TorqueState.HOLDING and (changed or now >= self._check_at):
            await self._check_torque(session, present)
        cool = present.temperature <= self._config.alarm.cool_below
        if self.torque is TorqueState.LIMP and now >= self._hold_at and cool:
            await self._hold(session, present)

    async def _check_torque(self, session: Ax12Session, present: Present) -> None:
        enabled, speed, limit = await self._settings(session)
        if not limit:
            self._go_limp()
        elif not enabled or speed != self._config.speed_word:
            self._report(Reason.DEVICE_FAULT, Severity.WARNING, "lost its settings, as after a brown-out: sent again")
            await self._hold(session, present)

    async def _hold(self, session: Ax12Session, present: Present) -> None:
        """Switch the torque on without a jump: first set the goal to the current position or the nearest limit."""
        config, joint = self._config, self._joint
        goal = min(max(present.position, joint.min_position), joint.max_position)
        words = (p.GOAL_POSITION, goal), (p.MOVING_SPEED, config.speed_word), (p.TORQUE_LIMIT, self._max_torque)
        await session.write(self.id, p.CW_MARGIN, bytes((config.margin, config.margin, config.slope, config.slope)))
        await session.write(self.id, p.GOAL_POSITION, b"".join(register.encode(value) for register, value in words))
        await session.write(self.id, p.TORQUE_ENABLE, b"\x01")
        enabled, _, limit = await self._settings(session)
        if not (enabled and limit):
            self._go_limp()
            return
        self.torque, self._goal = TorqueState.HOLDING, goal
        self._held_at = self._clock.now()
        if self._outage:
            self._outage = False
            self._report(Reason.DEVICE_READY, Severity.INFO, "torque on again")

    def _go_limp(self) -> None:
        """Start a waiting time after the unit removed its own torque."""
        reported, rest = self._outage, self._begin_rest()
        if not reported:
            text = f"torque lost after {alarm_names(self._error)}: waits {rest:g} s"
            self._report(Reason.DEVICE_FAULT, Severity.ERROR, text, error=int(self._error))

    def _begin_rest(self) -> float:
        """Start a waiting time and return its length (s), which doubles if the previous one ended too recently."""
        alarm, now = self._config.alarm, self._clock.now()
        if self._held_at is not None and now - self._held_at >= alarm.settled_after * SECOND:
            self._rest = alarm.rest
        rest = self._rest
        self.torque, self._outage = TorqueState.LIMP, True
        self._hold_at = now + round(rest * SECOND)
        self._rest = min(2 * rest, alarm.rest_max)
        return rest

    def _miss(self, why: str) -> None:
        self._misses += 1
        if self.torque is TorqueState.ABSENT or self._misses <= RETRIES:
            return
        self.torque = TorqueState.ABSENT
        self._present = None
        self._error = Alarm(0)
        self._ask_at = self._clock.now() + round(self._config.absent_interval * SECOND)
        self.report_absent(why)

    def report_absent(self, why: str) -> None:
        """Report that the unit does not answer."""
        self._outage = True
        self._report(
            Reason.DEVICE_TIMEOUT, Severity.WARNING, f"does not answer, will be asked again at intervals: {why}"
        )

    async def _settings(self, session: Ax12Session, retries: int = 0) -> tuple[int, int, int]:
        """Read the torque switch, the moving speed and the torque limit."""
        settings = 12  # bytes from the torque switch to the torque limit
        answer = await session.read(self.id, p.TORQUE_ENABLE, settings, retries)
        self._error, data = answer.error, answer.data
        self._check_at = self._clock.now() + round(self._config.check_interval * SECOND)
        return data[0], word(data, 8), word(data, 10)

    async def _answer_all(self, session: Ax12Session) -> None:
        """Set the status return level to answer every packet.

        Whether this write is answered depends on the old level.
        """
        with contextlib.suppress(DeviceTimeoutError):
            await session.write(self.id, p.STATUS_LEVEL, ANSWERS_ALL, retries=0)
        self._report(Reason.DEVICE_MISMATCH, Severity.INFO, "did not answer every packet: status return level set to 2")

    def _check(self, stored: bytes) -> None:
        model = word(stored, p.MODEL_NUMBER.address)
        if model != p.MODEL:
            raise WrongDeviceError(f"unit {self.id} ({self._name}): model {model}, expected an AX-12A ({p.MODEL})")
        low, high = word(stored, p.CW_LIMIT.address), word(stored, p.CCW_LIMIT.address)
        wanted = (self._joint.min_position, self._joint.max_position)
        if low > wanted[0] or high < wanted[1]:
            raise DeviceMismatchError(
                f"unit {self.id} ({self._name}): its angle limits are {low}..{high} (0..0: endless turn), "
                f"expected to allow {wanted[0]}..{wanted[1]}"
            )

    # Reports

    def _report_alarms(self, error: Alarm, now: int) -> None:
        """Report each error bit once; it is reported again only after all bits have been clear for a while."""
        if not error:
            if self._reported and now - self._clean_since >= self._config.alarm.settled_after * SECOND:
                self._reported = Alarm(0)
            return
        self._clean_since = now
        new = error & ~self._reported
        self._reported |= error
        if new:
            self._report(Reason.DEVICE_FAULT, Severity.WARNING, f"reports {alarm_names(new)}", error=int(error))

    def _report(self, reason: Reason, severity: Severity, text: str, **values: Value) -> None:
        self._events(reason, severity, self._source, f"{self._name} joint (unit {self.id}) {text}", **values)


class Ax12Driver:
    """Forwards joint goals as they arrive, in one sync write for both units, and reads both units between goals.

    The units have no watchdog: they hold their last goal when goals stop or the session ends. If one unit does not
    answer, the other continues; if none answers, the session is lost (12 V rail or bus).

    Args:
        config: calibration, rates, timeouts, alarms.
        port: the adapter's port, at 1 Mbaud.
        clock: time source; goals are stamped with the same clock.
        commands: joint goals.
        out: feedback; joint angles in rad with REP 103 signs.
        events: alarms, and units that stop or resume answering.
        name: service name.
    """

    def __init__(
        self,
        config: Ax12Config,
        port: Port,
        clock: Clock,
        commands: Subscription[StabiliserCommand],
        out: Publisher[StabiliserFeedback],
        events: EventSink,
        name: str = "stabiliser",
    ) -> None:
        self.name = name
        self._config = config
        self._port = port
        self._clock = clock
        self._commands = commands
        self._out = out
        self._pitch = Joint("pitch", config.pitch, config, clock, events, name)
        self._roll = Joint("roll", config.roll, config, clock, events, name)
        self._joints = (self._pitch, self._roll)

    async def run(self, ready: Ready) -> None:
        """Serve one session.

        Raises:
            DeviceLostError: the adapter was unplugged.
            DeviceTimeoutError: no unit answers.
            WrongDeviceError: another device answers, or units other than AX-12A.
            DeviceMismatchError: a unit's own limits contradict the configuration.
            PortBusyError: another process holds the port.
        """
        async with await self._port.open() as link:
            session = Ax12Session(link, self._clock, self._config.timeout)
            await self._join(session)
            ready()
            await self._serve(session)

    async def _join(self, session: Ax12Session) -> None:
        await session.find_echo(*(joint.id for joint in self._joints))
        missing: dict[Joint, str] = {}
        for joint in self._joints:
            joint.forget()
            try:
                await joint.join(session)
            except (DeviceTimeoutError, ProtocolError) as error:
                missing[joint] = str(error)
        if len(missing) == len(self._joints):
            ids = " and ".join(str(joint.id) for joint in self._joints)
            if session.strange >= 3:  # number of invalid bytes that indicates another device; fewer may be disturbances
                raise WrongDeviceError(
                    f"{self._port.name}: {session.strange} bytes, but no answer of an AX-12A: another "
                    f"device, another baud rate than {session.baud}, or several units with one id; "
                    f"expected ids {ids}"
                )
            raise DeviceTimeoutError(
                f"{self._port.name}: silent; expected AX-12A units {ids}: check the 12 V rail, and that "
                "the adapter is set to TTL"
            )
        for joint, why in missing.items():
            joint.report_absent(why)

    async def _serve(self, session: Ax12Session) -> None:
        schedule = Schedule(self._clock, self._config.rate, Lead.POLLING)
        while True:
            await self._follow(session, schedule.step())
            asked = self._clock.now()
            for joint in self._joints:
                await joint.poll(session)
            if all(joint.torque is TorqueState.ABSENT for joint in self._joints):
                raise DeviceTimeoutError(f"{self._port.name}: no unit answers any more: check the 12 V rail")
            self._publish(asked)

    async def _follow(self, session: Ax12Session, until: int) -> None:
        """Forward goals as they arrive."""
        while (command := await self._commands.next_within((until - self._clock.now()) / SECOND)) is not None:
            if self._clock.now() - command.stamp <= self._config.command_timeout * SECOND:
                await self._aim(session, command)

    async def _aim(self, session: Ax12Session, command: StabiliserCommand) -> None:
        angles = ((self._pitch, command.pitch), (self._roll, command.roll))
        goals = {joint.id: joint.goal(angle) for joint, angle in angles if joint.torque is TorqueState.HOLDING}
        if goals:
            await session.sync_write(p.GOAL_POSITION, goals)

    def _publish(self, asked: int) -> None:
        received = self._clock.now()
        self._out.put(
            StabiliserFeedback(
                stamp=(asked + received) // 2,
                received=received,
                seq=self._out.next_seq(),
                pitch=self._pitch.angle,
                roll=self._roll.angle,
                pitch_joint=self._pitch.feedback(),
                roll_joint=self._roll.feedback(),
            )
        )
