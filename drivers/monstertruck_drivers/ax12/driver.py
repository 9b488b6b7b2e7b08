"""Stabiliser driver: joint goals out; angles, loads, heat and alarms of both servos in."""

from typing import Final

from monstertruck_drivers.ax12 import protocol as p
from monstertruck_drivers.ax12.config import Ax12Config
from monstertruck_drivers.ax12.joint import Joint
from monstertruck_drivers.ax12.session import Session
from monstertruck_drivers.link import Port
from monstertruck_runtime.clock import SECOND, Clock
from monstertruck_runtime.errors import DeviceTimeoutError, ProtocolError, WrongDeviceError
from monstertruck_runtime.ports import EventSink, Publisher, Ready, Subscription
from monstertruck_runtime.schedule import QUESTIONS, Schedule
from monstertruck_schemas.plan import StabiliserCommand
from monstertruck_schemas.sensor import StabiliserFeedback, TorqueState

STRANGE: Final = 3
"""Bytes out of form that show another device; fewer may be disturbances."""


class Ax12Driver:
    """Passes joint goals on as they come, by one sync write for both units, and reads both in between.

    The units have no watchdog: they hold their last goal when goals stop or the session ends. A unit that does not
    answer leaves the other one working; when none answers, the session is lost (12 V rail or bus).

    Args:
        config: calibration, rates, time-outs, alarms.
        port: the adapter's port, at 1 Mbaud.
        clock: time; the goals' stamps are of the same clock.
        commands: joint goals.
        out: feedback, joint angles in rad, REP 103 signs.
        events: alarms, losses and returns of the units.
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
            DeviceLostError: unplugged.
            DeviceTimeoutError: no unit answers.
            WrongDeviceError: another device answers, or units that are no AX-12A.
            DeviceMismatchError: a unit's own limits contradict the configuration.
            PortBusyError: another process holds the port.
        """
        async with await self._port.open() as link:
            session = Session(link, self._clock, self._config.timeout)
            await self._join(session)
            ready()
            await self._serve(session)

    async def _join(self, session: Session) -> None:
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
            if session.strange >= STRANGE:
                raise WrongDeviceError(
                    f"{self._port.name}: {session.strange} bytes, but no answer of an AX-12A: another device, another "
                    f"baud rate than {p.BAUD}, or several units with one id; expected ids {ids}"
                )
            raise DeviceTimeoutError(
                f"{self._port.name}: silence; expected AX-12A units {ids}: is the 12 V rail up, the adapter at TTL?"
            )
        for joint, why in missing.items():
            joint.tell_absent(why)

    async def _serve(self, session: Session) -> None:
        schedule = Schedule(self._clock, self._config.rate, QUESTIONS)
        while True:
            await self._follow(session, schedule.step())
            asked = self._clock.now()
            for joint in self._joints:
                await joint.poll(session)
            if all(joint.torque is TorqueState.ABSENT for joint in self._joints):
                raise DeviceTimeoutError(f"{self._port.name}: no unit answers any more: is the 12 V rail down?")
            self._publish(asked)

    async def _follow(self, session: Session, until: int) -> None:
        """Pass goals on as they come."""
        while (command := await self._commands.next_within((until - self._clock.now()) / SECOND)) is not None:
            if self._clock.now() - command.stamp <= self._config.command_timeout * SECOND:
                await self._aim(session, command)

    async def _aim(self, session: Session, command: StabiliserCommand) -> None:
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
