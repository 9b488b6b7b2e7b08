"""Steering driver: sends servo targets; reads pulses, errors and the battery voltage."""

import contextlib

from monstertruck_drivers.battery.monitor import BatteryMonitor
from monstertruck_drivers.link import Port
from monstertruck_drivers.maestro.config import BatteryInputConfig, MaestroConfig
from monstertruck_drivers.maestro.protocol import ADC_MAX, Encoder, error_names
from monstertruck_drivers.maestro.session import MaestroSession
from monstertruck_drivers.transaction import Misses
from monstertruck_runtime.clock import SECOND, Clock, Lead, Schedule
from monstertruck_runtime.errors import DeviceLostError
from monstertruck_runtime.ports import EventSink, Publisher, Ready, Subscription
from monstertruck_schemas.base import servo_fields
from monstertruck_schemas.cmd import SteeringCommand
from monstertruck_schemas.event import Severity
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.sensor import Battery, DriveFeedback, SteeringFeedback


class MaestroDriver:
    """Sends every steering command immediately, and polls pulses, errors and the battery between commands.

    **Deadman.** The Maestro's serial timeout (set once in the unit, about 0.5 s) sends its channels home when no valid
    command arrives; polling resets the timeout just as targets do. A command is stale ``command_timeout`` after its
    stamp. Then the servos hold, and an explicit target releases the deadman line, if configured. With ``deadman_feed:
    fresh`` the driver then sends nothing until the next command, so that the timeout also trips although the driver
    still runs; feedback and battery pause meanwhile. With ``always`` polling continues, and the timeout protects only
    against a hung or dead process. Before the first command of a session, the line is low and polling is active. The
    unit's settings define where channels go: deadman line "Off", steering "Ignore". A command can also lower the line,
    which is the only way to stop a motor whose link is lost.

    Args:
        config: calibration and rates.
        port: the Maestro's Command Port.
        clock: time source; commands are stamped with the same clock.
        commands: steering commands from the gate.
        out: feedback; servo angles in rad, left positive.
        battery: pack voltage; None if another device measures the battery.
        events: device errors.
        name: service name.
        drive: motor feedback, whose current explains the battery sag.
    """

    def __init__(
        self,
        config: MaestroConfig,
        port: Port,
        clock: Clock,
        commands: Subscription[SteeringCommand],
        out: Publisher[SteeringFeedback],
        battery: Publisher[Battery] | None,
        events: EventSink,
        name: str = "steering",
        *,
        drive: Subscription[DriveFeedback] | None = None,
    ) -> None:
        self.name = name
        self._config = config
        self._port = port
        self._clock = clock
        self._commands = commands
        self._out = out
        self._events = events
        self._battery = None
        if battery is not None and config.battery is not None:
            self._battery = BatteryInput(config.battery, BatteryMonitor(config.battery, battery, events, name, drive))
        self._angles = [0.0] * len(config.servos)

    def _start_session(self) -> None:
        self._command: SteeringCommand | None = None
        """Latest command."""
        self._fresh: SteeringCommand | None = None
        """Latest command until it is stale."""
        self._failing = False
        self._misses = Misses()

    async def run(self, ready: Ready) -> None:
        """Serve one session.

        Raises:
            DeviceLostError: the unit was unplugged.
            DeviceTimeoutError: three consecutive polls got no answer; at the start, the mode or the port may be wrong.
            ProtocolError: three consecutive answers were malformed.
            WrongDeviceError: another device answers on this port.
            PortBusyError: another process holds the port.
        """
        config = self._config
        self._start_session()
        async with await self._port.open() as link:
            encoder = Encoder(config.device_number, config.use_crc)
            session = MaestroSession(link, self._clock, encoder, config.answer_timeout)
            # Errors pending since power-up are unrelated to this session.
            await session.identify(*(servo.channel for servo in config.servos))
            self._restore(session)
            ready()
            try:
                await self._serve(session)
            finally:
                with contextlib.suppress(DeviceLostError):
                    session.send(*self._line(session, high=False), *self._more(session, rest=True))

    async def _serve(self, session: MaestroSession) -> None:
        schedule = Schedule(self._clock, self._config.poll_rate, Lead.POLLING)
        every = max(1, round(self._config.poll_rate / self._config.battery_rate))
        cycle = 0
        while True:
            await self._follow(session, schedule.step())
            session.require_link()
            self._watch(session)
            if self._fresh is not None or self._command is None or self._config.deadman_feed == "always":
                await self._poll(session, self._battery if cycle % every == 0 else None)
            cycle += 1

    async def _follow(self, session: MaestroSession, until: int) -> None:
        """Forward commands as they arrive."""

        def pass_on(command: SteeringCommand) -> bool:
            if self._is_fresh(command):
                self._command = self._fresh = command
                line = self._line(session, high=command.deadman)
                session.send(*self._targets(session, command), *line, *self._more(session))
            return True

        while (waiting := await self._commands.next_within((until - self._clock.now()) / SECOND, pass_on)) is not None:
            pass_on(waiting)

    def _is_fresh(self, command: SteeringCommand) -> bool:
        return self._clock.now() - command.stamp <= self._config.command_timeout * SECOND

    def _watch(self, session: MaestroSession) -> None:
        """Release the deadman line when commands cease to arrive."""
        if self._fresh is not None and not self._is_fresh(self._fresh):
            self._fresh = None
            session.send(*self._line(session, high=False), *self._more(session, rest=True))
            text = f"no steering command for {self._config.command_timeout} s: servos keep their position"
            self._events(Reason.TICK_STALLED, Severity.WARNING, self.name, text)

    def _targets(self, session: MaestroSession, command: SteeringCommand) -> list[bytes]:
        pairs = zip(self._config.servos, command.servos, strict=True)
        return [session.encode.set_target(servo.channel, servo.quarters(angle)) for servo, angle in pairs]

    def _line(self, session: MaestroSession, *, high: bool) -> list[bytes]:
        channel = self._config.deadman_channel
        line_high = 8000
        # 4000: targets of a digital output, quarter microseconds: on either side of the device's threshold
        return [] if channel is None else [session.encode.set_target(channel, line_high if high else 4000)]

    def _more(self, session: MaestroSession, *, rest: bool = False) -> list[bytes]:
        """Commands for other devices on the unit; ``rest`` stops those devices."""
        del session, rest
        return []

    def _polled(self, stamp: int, received: int) -> None:
        """Publish the feedback of other devices after a poll."""

    def _restore(self, session: MaestroSession) -> None:
        """Send all settings that a Maestro loses at power-up or after an error."""
        packets: list[bytes] = []
        for servo in self._config.servos:
            packets.append(session.encode.set_speed(servo.channel, servo.speed))
            packets.append(session.encode.set_acceleration(servo.channel, servo.acceleration))
        if self._command is not None:
            packets += self._targets(session, self._command)
        alive = self._fresh is not None and self._fresh.deadman
        session.send(*packets, *self._line(session, high=alive), *self._more(session, rest=not alive))

    async def _poll(self, session: MaestroSession, battery: "BatteryInput | None") -> None:
        config = self._config
        channels = [servo.channel for servo in config.servos] + (battery.channels if battery else [])
        asked = self._clock.now()
        with self._misses:
            *positions, errors = await session.ask(
                *(session.encode.get_position(channel) for channel in channels), session.encode.get_errors()
            )
            session.check(positions, errors)
        if self._misses.count:
            # The lost answer may have held the only report of an error.
            self._restore(session)
            return
        received = self._clock.now()
        stamp = (asked + received) // 2
        self._report(session, stamp, received, positions, errors)
        self._polled(stamp, received)
        if battery is not None:
            battery.take(stamp, received, *positions[-len(battery.channels) :])

    def _report(self, session: MaestroSession, stamp: int, received: int, positions: list[int], errors: int) -> None:
        positions = positions[: len(self._angles)]
        strange = False
        for i, (servo, position) in enumerate(zip(self._config.servos, positions, strict=True)):
            if position == 0:
                continue  # no pulses: the servo stays in place
            if servo.within_limits(position):
                self._angles[i] = servo.angle(position)
            else:
                strange = True
        pulsing = all(positions)
        lost = errors != 0 or strange or (self._command is not None and not pulsing)
        if lost:
            if not self._failing:
                what = ", ".join(error_names(errors)) or (
                    "pulses outside min_us to max_us" if strange else "pulses off"
                )
                text = f"the servo controller reports {what}: settings and targets sent again"
                self._events(Reason.DEVICE_FAULT, Severity.WARNING, self.name, text, error_word=errors)
            self._restore(session)
        self._failing = lost
        self._out.put(
            SteeringFeedback(
                stamp=stamp,
                received=received,
                seq=self._out.next_seq(),
                **servo_fields(self._angles),
                error_word=errors,
                trusted=errors == 0 and pulsing and not strange,
            )
        )


class BatteryInput:
    """Analog input that measures the battery."""

    def __init__(self, config: BatteryInputConfig, monitor: BatteryMonitor) -> None:
        self.channels = [config.channel] if config.current is None else [config.channel, config.current.channel]
        self._config = config
        self._monitor = monitor

    def take(self, stamp: int, received: int, raw: int, current: int | None = None) -> None:
        """Process one 10-bit voltage reading, and one current reading if the current is measured."""
        sensor = self._config.current
        amps = None if sensor is None or current is None else sensor.amps(current)
        self._monitor.take(stamp, received, self._config.volts(raw), at_limit=raw in (0, ADC_MAX), current=amps)
