"""Emulated Micro Maestro, byte for byte."""

import asyncio
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np

from monstertruck_drivers.cable import DeviceEnd, EmulatedPort
from monstertruck_drivers.emulation import EmulatorSetup, ReceivedBytes, ServoPlant
from monstertruck_drivers.fault_table import FaultTable, FaultyDevice, LateAnswers
from monstertruck_drivers.maestro.protocol import (
    ADC_MAX,
    CHANNELS,
    OUTPUT_THRESHOLD,
    Code,
    Decoder,
    Error,
    ServoCommand,
)
from monstertruck_drivers.signals import SignalKind, Signals
from monstertruck_runtime.clock import SECOND, Clock

TICK: Final = 10_000_000
"""Step of a ramp (ns)."""
AT_JUNK: Final = b"AT\r\nAT+CGMI\r\nATI\r\n"
"""Bytes that a modem manager sends to an unknown serial port."""

CHANNEL_ORDERS: Final = {
    Code.SET_TARGET: "target",
    Code.SET_SPEED: "speed",
    Code.SET_ACCELERATION: "acceleration",
}
GO_HOME: Final = "go_home"
CHANNEL_COMMANDS: Final = (Code.SET_TARGET, Code.SET_SPEED, Code.SET_ACCELERATION, Code.GET_POSITION)
"""Commands whose first data byte is a channel."""

Mode = Literal["dual_port", "uart"]
Home = float | Literal["off", "ignore"]
"""Error reaction of a channel: a pulse (us), no pulses, or no change."""


@dataclass(slots=True)
class Ramp:
    """Pulse of one channel as it ramps to its target (quarter microseconds; velocity per 10 ms)."""

    target: int = 0
    position: float = 0.0
    velocity: float = 0.0
    speed: int = 0
    acceleration: int = 0

    def aim(self, target: int) -> None:
        """Change the target. Without limits, and from or to 0 (no pulses), the change is immediate."""
        if target == 0 or self.target == 0 or not (self.speed or self.acceleration):
            self.position, self.velocity = float(target), 0.0
        self.target = target

    def step(self) -> None:
        """Advance the ramp by 10 ms."""
        left = self.target - self.position
        top = self.speed or math.inf
        if not self.acceleration:
            self.position += min(max(left, -top), top)
            return
        gain = self.acceleration / 8  # its unit is per 80 ms
        braking = (2 * gain * abs(left)) ** 0.5
        wanted = math.copysign(min(top, braking), left)
        self.velocity += min(max(wanted - self.velocity, -gain), gain)
        if abs(left) <= max(gain, abs(self.velocity)) and abs(self.velocity) <= 2 * gain:
            self.position, self.velocity = float(self.target), 0.0
        else:
            self.position += self.velocity


class MaestroEmulator(FaultyDevice):
    """A Micro Maestro 6 powered by USB.

    The arguments are settings in the unit's non-volatile memory; targets, speeds and accelerations are volatile.

    Faults (``inject``): ``brown_out [seconds]``, ``at_junk``, ``mode dual_port|uart``, ``mute on|off`` (no answers),
    ``late SECONDS [COUNT]`` (late answers), ``pulse CHANNEL MICROSECONDS`` (another program moves the pulse beyond its
    limits), ``error BIT``, ``rail VOLTS``, ``noise LSB``, ``battery VOLTS``.

    Args:
        clock: time.
        servos: servo physics; if None, the analog inputs read ``analog_v`` and the pulses have no effect.
        seed: seed for the analog noise.
        mode: serial mode; in ``uart`` (the factory setting), bytes over USB are ignored.
        crc: whether commands must carry a CRC-7 byte.
        device_number: device number in the Pololu protocol.
        serial_timeout_s: serial timeout (s), after which all channels go home; 0 disables it.
        home: home setting for each channel; default: "off" for outputs, "ignore" for others.
        inputs: channels that are analog inputs.
        outputs: channels that are digital outputs.
        limits_us: minimum and maximum pulse (us); targets are clamped.
        noise_lsb: standard deviation of the analog noise.
        rail_drift_v: amplitude of a slow (60 s) swing of the 5 V rail, the reference of the inputs.
        usb: the unit's port; a brown-out unplugs and replugs it.
        on_output: called with (channel, high) when a digital output changes, whatever the cause.
    """

    def __init__(
        self,
        clock: Clock,
        servos: ServoPlant | None = None,
        *,
        seed: int = 0,
        mode: Mode = "dual_port",
        crc: bool = False,
        device_number: int = 12,
        serial_timeout_s: float = 0.0,
        home: Mapping[int, Home] | None = None,
        inputs: frozenset[int] = frozenset({5}),
        outputs: frozenset[int] = frozenset({2, 3, 4}),
        limits_us: tuple[float, float] = (992.0, 2000.0),
        noise_lsb: float = 0.7,
        rail_drift_v: float = 0.0,
        usb: EmulatedPort | None = None,
        on_output: Callable[[int, bool], None] | None = None,
    ) -> None:
        self.name = "maestro"
        self.usb = usb
        self.on_output = on_output
        self.received = ReceivedBytes()
        """Bytes the host sent to the Command Port, for tests."""
        self.analog_v = dict.fromkeys(range(CHANNELS), 2.4)
        """Voltages of the inputs without ``servos``."""
        self.rail_v = 5.0
        self._clock = clock
        self._servos = servos
        self._rng = np.random.default_rng(seed)
        kinds = dict.fromkeys([f"position_{channel}" for channel in range(CHANNELS)] + ["errors"], SignalKind.NUMBER)
        orders = [f"{name}_{channel}" for name in CHANNEL_ORDERS.values() for channel in range(CHANNELS)]
        kinds |= dict.fromkeys(orders, SignalKind.ORDER)
        self.signals = Signals(clock.now, kinds | {GO_HOME: SignalKind.SWITCH}, self._rng)
        self._mode = mode
        self.set_serial_timeout(serial_timeout_s)
        self._home: dict[int, Home] = {
            channel: "off" if channel in outputs else "ignore" for channel in range(CHANNELS)
        }
        self._home.update(home or {})
        self._inputs = inputs
        self._outputs = outputs
        self._limits = (round(limits_us[0] * 4), round(limits_us[1] * 4))
        self._late = LateAnswers()
        self.faults = FaultTable(
            self.name,
            {
                "brown_out [SECONDS]": self._brown_out,
                "at_junk": self._receive_junk,
                "mode dual_port|uart": self._set_mode,
                "mute on|off": False,
                "late SECONDS [COUNT]": self._late.start,
                "pulse CHANNEL MICROSECONDS": self._move,
                "error BIT": lambda bit: self._fail(Error(1 << int(bit))),
                "rail VOLTS": self._set_rail,
                "noise LSB": noise_lsb,
                "battery VOLTS": self._set_battery,
            },
        )
        self._drift = rail_drift_v
        self._decoder = Decoder(device_number, crc)
        """Delays of the next answers (s)."""
        self._powered = True
        self._fed_again = asyncio.Event()
        self._levels = dict.fromkeys(outputs, False)
        self._boot()
        if servos is not None:
            servos.attach(self)

    def _boot(self) -> None:
        now = self._clock.now()
        self._decoder = Decoder(self._decoder.device, self._decoder.crc)
        self._ramps = [Ramp() for _ in range(CHANNELS)]
        self._ticked = now // TICK
        # A serial signal error is usually pending after power-up.
        self._errors = Error.SERIAL_SIGNAL
        self._fed = now
        self._timed_out = False
        for channel, home in self._home.items():
            if isinstance(home, int | float):
                self._aim(channel, round(4 * home))
        self._report_outputs()

    def set_serial_timeout(self, seconds: float) -> None:
        """Store the serial timeout (s), after which all channels go home; 0 disables it."""
        self._timeout = round(seconds * SECOND)

    # Interface to the simulated world

    def pulse_us(self, channel: int, time_ns: int) -> float | None:
        """Pulse at ``time_ns`` (us); None if no pulses are sent."""
        self._tick(time_ns)
        position = self._ramps[channel].position
        return position / 4 if position > 0 else None

    def output(self, channel: int) -> bool:
        """Level of a digital output."""
        return channel in self._outputs and self._ramps[channel].target >= OUTPUT_THRESHOLD

    def power_cycle(self) -> None:
        """Switch the supply off and on: targets, speeds and errors are lost; settings persist."""
        self._advance()
        self._boot()
        self._fed_again.set()

    async def run(self, end: DeviceEnd) -> None:
        """Serve the Command Port."""
        end.on_plug = self._plugged
        async with asyncio.TaskGroup() as group:
            group.create_task(self._watch())
            while True:
                self._take(end, await end.read())

    def _receive_junk(self) -> None:
        self._execute(AT_JUNK)  # the unit sends no answer to these bytes

    def _set_mode(self, mode: str) -> None:
        modes: dict[str, Mode] = {"dual_port": "dual_port", "uart": "uart"}
        self._mode = modes[mode]

    def _move(self, channel: str, pulse: str) -> None:
        self._ramps[int(channel)].aim(round(4 * float(pulse)))

    def _set_rail(self, volts: str) -> None:
        self.rail_v = float(volts)

    def _set_battery(self, volts: str) -> None:
        self.analog_v.update(dict.fromkeys(self._inputs, float(volts) / 10))

    # Serving

    def _take(self, end: DeviceEnd, data: bytes) -> None:
        answer = self._execute(data)
        if answer and not self.faults["mute"]:
            end.write(answer, self._late.take(0.0))

    def _execute(self, data: bytes) -> bytes:
        self.received.extend(data)
        if self._mode == "uart":
            return b""
        self._advance()
        answers = b""
        for item in self._decoder.feed(data):
            if isinstance(item, Error):
                self._fail(item)
                continue
            self._fed = self._clock.now()
            self._timed_out = False
            self._fed_again.set()
            answers += self._obey(item)
        self._report_outputs()
        return answers

    def _obey(self, command: ServoCommand) -> bytes:
        code, data = command.code, command.data
        if code in CHANNEL_COMMANDS and data[0] >= CHANNELS:
            self._fail(Error.PROTOCOL)
            return b""
        answer = b""
        match code:
            case Code.SET_TARGET | Code.SET_SPEED | Code.SET_ACCELERATION:
                self._order(Code(code), data[0], command.value)
            case Code.MINI_SSC if data[0] < CHANNELS:
                # Factory neutral 1500 us and range 476.25 us to either side of 127.
                self._order(Code.SET_TARGET, data[0], 6000 + (data[1] - 127) * 15)
            case Code.GO_HOME:
                self.signals.order(GO_HOME, self._clock.now(), self._order_home)
            case Code.GET_POSITION:
                position = self.signals.report(f"position_{data[0]}", self._position(data[0]))
                answer = min(max(position, 0), 0xFFFF).to_bytes(2, "little")
            case Code.GET_ERRORS:
                errors = self.signals.report("errors", int(self._errors))
                answer = min(max(errors, 0), 0xFFFF).to_bytes(2, "little")
                self._errors = Error(0)
            case Code.GET_MOVING_STATE:
                answer = b"\x00"  # firmware bug of the Micro: it reports 0 even while moving
            case Code.GET_SCRIPT_STATUS:
                answer = b"\x01"  # no script is stored
            case _:
                pass  # script commands: no script to run
        return answer

    def _order_home(self, asked: int) -> None:
        if self._clock.now() > asked:
            self._advance()
        self._go_home()
        self._report_outputs()

    def _order(self, code: Code, channel: int, value: int) -> None:
        asked = self._clock.now()

        def obey(given: int) -> None:
            if self._clock.now() > asked:
                self._advance()
            given = min(max(given, 0), 0x3FFF)
            if code is Code.SET_TARGET:
                self._aim(channel, given)
            elif code is Code.SET_SPEED:
                self._ramps[channel].speed = given
            else:
                self._ramps[channel].acceleration = min(given, 255)
            self._report_outputs()

        self.signals.order(f"{CHANNEL_ORDERS[code]}_{channel}", value, obey)

    def _aim(self, channel: int, quarters: int) -> None:
        if channel in self._inputs or not self._powered:
            return
        low, high = self._limits
        self._ramps[channel].aim(min(max(quarters, low), high) if quarters else 0)

    def _position(self, channel: int) -> int:
        if channel not in self._inputs:
            return round(self._ramps[channel].position)
        now = self._clock.now()
        volts = self.analog_v[channel] if self._servos is None else self._servos.analog_volts(channel, now)
        rail = self.rail_v + self._drift * math.sin(2 * math.pi * now / (60 * SECOND))
        counts = volts / rail * ADC_MAX + self.faults["noise"] * float(self._rng.standard_normal())
        return min(max(round(counts), 0), ADC_MAX)

    def _fail(self, error: Error) -> None:
        self._advance()
        self._errors |= error
        self._go_home()
        self._report_outputs()

    def _go_home(self) -> None:
        for channel, home in self._home.items():
            if home != "ignore":
                self._aim(channel, 0 if home == "off" else round(4 * home))

    def _report_outputs(self) -> None:
        for channel in self._outputs:
            level = self.output(channel)
            if level != self._levels[channel]:
                self._levels[channel] = level
                if self.on_output is not None:
                    self.on_output(channel, level)

    # Time

    def _advance(self) -> None:
        """Let the servos follow the old targets until now, then advance the ramps."""
        now = self._clock.now()
        if self._servos is not None:
            self._servos.advance(now)
        self._tick(now)

    def _tick(self, time_ns: int) -> None:
        ticks = time_ns // TICK - self._ticked
        if ticks <= 0:
            return
        self._ticked += ticks
        for ramp in self._ramps:
            for _ in range(ticks):
                if ramp.position == ramp.target and ramp.velocity == 0:
                    break
                ramp.step()

    async def _watch(self) -> None:
        """Run the serial timeout, which trips when no valid command arrives, even while the host is silent."""
        while self._timeout:
            self._fed_again.clear()
            if self._timed_out:
                await self._fed_again.wait()
            await self._clock.sleep_until(self._fed + self._timeout)
            if not self._timed_out and self._clock.now() - self._fed >= self._timeout:
                self._timed_out = True
                self._fail(Error.SERIAL_TIMEOUT)

    # Supply

    def _plugged(self, plugged: bool) -> None:
        """Power the logic from USB."""
        self._powered = plugged
        self.power_cycle()

    def _brown_out(self, seconds: str = "0.5") -> None:
        """Simulate a brown-out due to a stalled servo: the unit leaves USB and returns without its volatile state."""
        if self.usb is None:
            self.power_cycle()
        else:
            self.usb.unplug()
            asyncio.get_running_loop().call_later(float(seconds), self.usb.plug)


def emulated(setup: EmulatorSetup) -> MaestroEmulator:
    """Create a simulated truck's servo controller."""
    servos = setup.physics.servos
    return MaestroEmulator(setup.clock, servos, seed=setup.seed, inputs=servos.inputs)
