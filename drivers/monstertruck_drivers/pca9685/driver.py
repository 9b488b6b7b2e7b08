"""Steering driver for a PCA9685: sends pulses and reads the chip's registers back."""

import contextlib

from monstertruck_drivers.link import Port
from monstertruck_drivers.pca9685.config import Pca9685Config
from monstertruck_drivers.pca9685.protocol import pulse
from monstertruck_drivers.pca9685.session import Pca9685Session
from monstertruck_drivers.transaction import Misses
from monstertruck_runtime.clock import SECOND, Clock, Lead, Schedule
from monstertruck_runtime.errors import DeviceFaultError, DeviceLostError
from monstertruck_runtime.ports import EventSink, Publisher, Ready, Subscription
from monstertruck_schemas.base import servo_fields
from monstertruck_schemas.cmd import SteeringCommand
from monstertruck_schemas.event import Severity
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.sensor import Battery, DriveFeedback, SteeringFeedback


class Pca9685Driver:
    """Sends every steering command immediately, and reads the registers back between commands.

    **No watchdog.** The chip repeats the latest pulses until it receives new ones or loses its supply, even while the
    computer hangs. When commands are stale, the servos hold. If registers differ from the values written, as after the
    chip has lost its supply, the driver rewrites the registers and reports an event.

    Args:
        config: calibration and rates.
        port: the I2C bus.
        clock: time source; commands are stamped with the same clock.
        commands: steering commands from the gate.
        out: feedback: current pulses, as servo angles in rad, left positive.
        battery: not used, because the chip measures nothing.
        events: chip faults.
        name: service name.
        drive: not used.
    """

    def __init__(
        self,
        config: Pca9685Config,
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
        del battery, drive
        self.name = name
        self._config = config
        self._port = port
        self._clock = clock
        self._commands = commands
        self._out = out
        self._events = events
        self._angles = [0.0, 0.0]

    async def run(self, ready: Ready) -> None:
        """Serve one session.

        Raises:
            DeviceLostError: the bus does not exist or was removed.
            DeviceTimeoutError: three consecutive transfers were not acknowledged, or nothing answers at the chip's
                address at the start.
            WrongDeviceError: another device answers at the chip's address.
            PortBusyError: another process holds the emulated bus.
            DeviceFaultError: a channel that should be at rest read back another value, twice in a row or while the chip
                is asleep; all pulses are then off.
        """
        config = self._config
        async with await self._port.open() as link:
            session = Pca9685Session(link, self._clock, config.address, config.answer_timeout)
            self._sent: dict[int, int] = {}
            """Latest counts sent, by channel."""
            await self._rest_before_waking(session)
            await session.set_up(config.prescale)
            self._command: SteeringCommand | None = None
            self._stale = self._failing = False
            self._misses = Misses()
            await self._write(session, self._more(rest=True))
            ready()
            try:
                await self._serve(session)
            finally:
                with contextlib.suppress(DeviceLostError):
                    for channel, counts in self._more(rest=True).items():
                        session.send(pulse(channel, counts))

    async def _serve(self, session: Pca9685Session) -> None:
        schedule = Schedule(self._clock, self._config.poll_rate, Lead.POLLING)
        while True:
            until = schedule.step()
            while (command := await self._commands.next_within((until - self._clock.now()) / SECOND)) is not None:
                if self._is_fresh(command):
                    self._command, self._stale = command, False
                    with self._misses:
                        await self._write(session, self._targets(command) | self._more())
            await self._watch(session)
            with self._misses:
                await self._poll(session)

    def _is_fresh(self, command: SteeringCommand) -> bool:
        return self._clock.now() - command.stamp <= self._config.command_timeout * SECOND

    async def _watch(self, session: Pca9685Session) -> None:
        """Report missing commands."""
        if self._command is None or self._stale or self._is_fresh(self._command):
            return
        self._stale = True
        text = f"no steering command for {self._config.command_timeout} s: servos keep their position"
        self._events(Reason.TICK_STALLED, Severity.WARNING, self.name, text)
        with self._misses:
            await self._write(session, self._more(rest=True))

    def _targets(self, command: SteeringCommand) -> dict[int, int]:
        pairs = zip(self._config.servos, (command.front_servo, command.rear_servo), strict=False)
        return {servo.channel: self._config.counts(servo.pulse_us(angle)) for servo, angle in pairs}

    def _more(self, *, rest: bool = False) -> dict[int, int]:
        """Counts by channel for other devices on the chip; ``rest`` stops those devices."""
        del rest
        return {}

    def _restarted(self) -> None:
        """Handle a chip that has lost its settings and thus its pulses."""

    def _polled(self, stamp: int, received: int) -> None:
        """Publish the feedback of other devices after a poll."""

    async def _write(self, session: Pca9685Session, targets: dict[int, int]) -> None:
        """Write pulses; the next poll repeats a write that was lost."""
        self._sent |= targets
        for channel, counts in targets.items():
            await session.write(pulse(channel, counts))

    async def _require_rest(self, session: Pca9685Session, differ: list[int]) -> None:
        """Switch off all pulses if a channel does not come to rest, so that a speed controller lets its motor coast.

        Raises:
            DeviceFaultError: see ``run``.
        """
        rest = self._more(rest=True)
        if unruly := [channel for channel in differ if self._sent[channel] == rest.get(channel)]:
            await session.sleep()
            raise _unruly(session, unruly)

    async def _rest_before_waking(self, session: Pca9685Session) -> None:
        """Bring the channels of a sleeping chip to rest, so that an attempt to restart it causes no motion.

        Raises:
            DeviceFaultError: see ``run``.
        """
        if not await session.asleep():
            return
        await session.sleep()  # after power-up it does not increment the register
        rest = self._more(rest=True)
        await self._write(session, rest)
        if unruly := [channel for channel, counts in rest.items() if await session.counts(channel) != counts]:
            raise _unruly(session, unruly)

    async def _poll(self, session: Pca9685Session) -> None:
        asked, config = self._clock.now(), self._config
        present = {servo.channel: await session.counts(servo.channel) for servo in config.servos}
        present |= {channel: await session.counts(channel) for channel in self._sent if channel not in present}
        set_up = await session.is_set_up(config.prescale)
        received = self._clock.now()
        differ = sorted(channel for channel, counts in self._sent.items() if present[channel] != counts)
        lost = bool(differ) or not set_up
        if not set_up:
            self._restarted()
        if lost:
            if self._failing:
                await self._require_rest(session, differ)
            else:
                what = f"channels {differ} differ" if set_up else "mode or frequency lost"
                text = f"the PCA9685's registers are wrong ({what}): settings and pulses sent again"
                self._events(Reason.DEVICE_FAULT, Severity.WARNING, self.name, text)
            await session.set_up(config.prescale)
            await self._write(session, dict(self._sent) | self._more(rest=self._command is None or self._stale))
        self._failing = lost
        for i, servo in enumerate(config.servos):
            if counts := present[servo.channel]:
                self._angles[i] = servo.angle_of(config.pulse_us(counts))
        stamp = (asked + received) // 2
        self._out.put(
            SteeringFeedback(
                stamp=stamp,
                received=received,
                seq=self._out.next_seq(),
                **servo_fields(self._angles),
                error_word=0,
                trusted=not lost and all(present[servo.channel] for servo in config.servos),
            )
        )
        self._polled(stamp, received)


def _unruly(session: Pca9685Session, channels: list[int]) -> DeviceFaultError:
    return DeviceFaultError(f"{session.name}: channels {channels} do not come to rest: all pulses are off")
