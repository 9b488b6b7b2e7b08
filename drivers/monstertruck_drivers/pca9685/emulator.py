"""Emulated PCA9685, register by register, with servos and a speed controller on its outputs."""

import asyncio
from typing import Final

import numpy as np

from monstertruck_drivers.cable import DeviceEnd
from monstertruck_drivers.emulation import EmulatorSetup, MotorPlant, ServoPlant
from monstertruck_drivers.esc_emulator import EscEmulator
from monstertruck_drivers.fault_table import FaultTable, FaultyDevice
from monstertruck_drivers.i2c.protocol import serve
from monstertruck_drivers.pca9685.config import Pca9685Config, Pca9685EscConfig
from monstertruck_drivers.pca9685.protocol import (
    ADDRESS,
    CHANNELS,
    COUNTS,
    GENERAL_CALL,
    LAST_OF_BLOCK,
    MODE1_RESET,
    MODE2_RESET,
    OWN_ADDRESSES,
    PRESCALE_RESET,
    PRESCALES,
    RESET_BYTE,
    WAKE_UP,
    PwmMode1,
    PwmMode2,
    PwmRegister,
    count_us,
    counts_of,
    register_of,
)
from monstertruck_drivers.signals import SignalKind, Signals
from monstertruck_runtime.clock import SECOND, Clock

SUB_BITS: Final = (PwmMode1.SUB1, PwmMode1.SUB2, PwmMode1.SUB3, PwmMode1.ALLCALL)
"""Bits that enable the chip's answers at the addresses in registers 2 to 5."""
_POSITION: Final = "counts_{}"
_TARGET: Final = "target_{}"


class Pca9685Emulator(FaultyDevice):
    """A PCA9685 powered from the bus.

    Without the auto-increment bit, every byte of a transfer reads or writes the same register. The prescaler can be set
    only in sleep mode. Entering sleep with running outputs sets the restart bit; the outputs then stay off until that
    bit or their registers are written. Also emulated, according to the data sheet: sub-addresses, all-call, reset by
    general call, both full bits, ``ALL_LED`` registers that read as zero.

    Faults (``inject``): ``brown_out`` (supply off and on), ``absent on|off`` (acknowledges nothing), ``oscillator HZ``.

    Args:
        clock: time.
        servos: servo physics; if None, the pulses have no effect.
        address: address set by its pins.
        oscillator: oscillator frequency (Hz).
        seed: seed for the signal faults.
    """

    def __init__(
        self,
        clock: Clock,
        servos: ServoPlant | None = None,
        *,
        address: int = ADDRESS,
        oscillator: float = 25e6,
        seed: int = 0,
    ) -> None:
        self.name = "pca9685"
        self.address = address
        self.oscillator = oscillator
        self._clock = clock
        self._servos = servos
        kinds = dict.fromkeys((_POSITION.format(channel) for channel in range(CHANNELS)), SignalKind.NUMBER)
        kinds |= dict.fromkeys((_TARGET.format(channel) for channel in range(CHANNELS)), SignalKind.ORDER)
        self.signals = Signals(clock.now, kinds, np.random.default_rng(seed))
        self.faults = FaultTable(
            self.name,
            {
                "brown_out": self.power_cycle,
                "absent on|off": False,
                "oscillator HZ": self._set_oscillator,
            },
        )
        self._powered = True
        self._boot()
        if servos is not None:
            servos.attach(self)

    def _boot(self) -> None:
        self._registers = bytearray(256)
        self._registers[: 2 + len(OWN_ADDRESSES)] = bytes((MODE1_RESET, MODE2_RESET)) + OWN_ADDRESSES
        for channel in range(CHANNELS):
            self._registers[register_of(channel) + 3] = 0x10
        self._registers[PwmRegister.PRE_SCALE] = PRESCALE_RESET
        self._pointer = 0
        self._halted: set[int] = set()
        """Channels stopped by sleep."""
        self._awake_at = 0
        """Time from which the oscillator runs (ns)."""

    # Interface to the simulated world

    def pulse_us(self, channel: int, time_ns: int) -> float | None:
        """Pulse at ``time_ns`` (us); None if no pulses are sent, or the output is always on."""
        counts = counts_of(self._output(channel))
        asleep = self._registers[PwmRegister.MODE1] & PwmMode1.SLEEP or time_ns < self._awake_at
        if not self._powered or asleep or channel in self._halted or counts in (0, COUNTS):
            return None
        if self._registers[PwmRegister.MODE2] & PwmMode2.INVRT:
            counts = COUNTS - counts
        return counts * count_us(self._registers[PwmRegister.PRE_SCALE], self.oscillator)

    def _output(self, channel: int) -> bytes:
        start = register_of(channel)
        return bytes(self._registers[start : start + 4])

    def power_cycle(self) -> None:
        """Switch the supply off and on: all registers are lost."""
        self._advance()
        self._boot()

    async def run(self, end: DeviceEnd) -> None:
        """Serve the bus until cancelled."""
        end.on_plug = self._plugged
        await serve(end, self.transfer)

    def _set_oscillator(self, hertz: str) -> None:
        self._advance()
        self.oscillator = float(hertz)

    # The bus

    def transfer(self, address: int, data: bytes, count: int) -> bytes | None:
        """Answer one transfer; None if it is not acknowledged."""
        if self.faults["absent"] or not self._powered:
            return None
        if address == GENERAL_CALL:
            if data != bytes((RESET_BYTE,)):
                return None
            self.power_cycle()
            return b""
        if address not in self._addresses():
            return None
        if data:
            if not self._exists(data[0]):
                return None
            self._pointer = data[0]
            self._advance()
            wanted: dict[int, bytearray] = {}
            for value in data[1:]:
                self._write(value, wanted)
            for channel, values in wanted.items():
                self._order(channel, bytes(values))
        return bytes(self._read() for _ in range(count))

    def _addresses(self) -> set[int]:
        mode = self._registers[PwmRegister.MODE1]
        others = zip(SUB_BITS, self._registers[PwmRegister.SUBADR1 : PwmRegister.ALLCALLADR + 1], strict=True)
        return {self.address} | {value >> 1 for bit, value in others if mode & bit}

    @staticmethod
    def _exists(register: int) -> bool:
        return register <= LAST_OF_BLOCK or register >= PwmRegister.ALL_LED_ON_L

    def _step(self) -> None:
        if self._registers[PwmRegister.MODE1] & PwmMode1.AI:
            over = self._pointer in (LAST_OF_BLOCK, PwmRegister.PRE_SCALE)
            self._pointer = 0 if over else self._pointer + 1

    def _read(self) -> int:
        register = self._pointer
        value = 0 if PwmRegister.ALL_LED_ON_L <= register < PwmRegister.PRE_SCALE else self._registers[register]
        channel, part = divmod(register - PwmRegister.LED0_ON_L, 4)
        if 0 <= channel < CHANNELS and part >= 2:
            off = int.from_bytes(self._output(channel)[2:], "little")
            shown = min(max(self.signals.report(_POSITION.format(channel), off), 0), 0x1FFF)
            value = shown >> 8 if part == 3 else shown & 0xFF
        self._step()
        return value

    def _write(self, value: int, wanted: dict[int, bytearray]) -> None:
        """Process one byte; pulses are collected in ``wanted``, by channel, until the stop condition."""
        register, mode = self._pointer, self._registers[PwmRegister.MODE1]
        self._step()
        channel, part = divmod(register - PwmRegister.LED0_ON_L, 4)
        if register == PwmRegister.MODE1:
            self._set_mode(value)
        elif register == PwmRegister.PRE_SCALE:
            if mode & PwmMode1.SLEEP:
                self._registers[register] = max(value, PRESCALES[0])
        elif PwmRegister.ALL_LED_ON_L <= register < PwmRegister.PRE_SCALE:
            part = register - PwmRegister.ALL_LED_ON_L
            for one in range(CHANNELS):
                self._registers[register_of(one) + part] = value & 0x1F if part % 2 else value
            self._restarted(set(range(CHANNELS)))
        elif 0 <= channel < CHANNELS:
            values = wanted.setdefault(channel, bytearray(self._output(channel)))
            values[part] = value & 0x1F if part % 2 else value
        else:
            self._registers[register] = value

    def _order(self, channel: int, values: bytes) -> None:
        """Handle the stop condition: the pulse takes effect and runs again after sleep."""
        start = register_of(channel)

        def obey(given: int) -> None:
            self._advance()
            self._registers[start : start + 4] = values[:2] + min(max(given, 0), 0x1FFF).to_bytes(2, "little")
            self._restarted({channel})

        self.signals.order(_TARGET.format(channel), int.from_bytes(values[2:], "little"), obey)

    def _restarted(self, channels: set[int]) -> None:
        self._halted -= channels
        self._registers[PwmRegister.MODE1] &= ~PwmMode1.RESTART & 0xFF

    def _set_mode(self, value: int) -> None:
        now, before = self._clock.now(), self._registers[PwmRegister.MODE1]
        restart: int = before & PwmMode1.RESTART
        if value & PwmMode1.SLEEP and not before & PwmMode1.SLEEP:
            running = {channel for channel in range(CHANNELS) if counts_of(self._output(channel))}
            self._halted |= running
            restart = PwmMode1.RESTART if self._halted else 0
        elif before & PwmMode1.SLEEP and not value & PwmMode1.SLEEP:
            self._awake_at = now + round(WAKE_UP * SECOND)
        elif value & PwmMode1.RESTART and restart and now >= self._awake_at:
            self._halted.clear()
            restart = 0
        external = before & PwmMode1.EXTCLK  # only a reset clears it
        self._registers[PwmRegister.MODE1] = value & ~PwmMode1.RESTART & 0xFF | external | restart

    def _advance(self) -> None:
        """Let the servos follow the old pulses until now."""
        if self._servos is not None:
            self._servos.advance(self._clock.now())

    def _plugged(self, plugged: bool) -> None:
        """Power the chip from the bus."""
        self._powered = plugged
        self.power_cycle()


class Pca9685EscEmulator(Pca9685Emulator):
    """The chip, its servos, and the speed controller with its motor.

    Faults (``inject``): all faults of ``Pca9685Emulator``.

    Args:
        clock: time.
        plant: the motor.
        servos: servo physics.
        settings: channels and pulses.
        seed: seed for the signal faults.
    """

    def __init__(
        self,
        clock: Clock,
        plant: MotorPlant,
        servos: ServoPlant | None = None,
        settings: Pca9685EscConfig | None = None,
        *,
        seed: int = 0,
    ) -> None:
        config = settings or Pca9685EscConfig()
        super().__init__(clock, servos, address=config.unit.address, oscillator=config.unit.oscillator, seed=seed)
        self._esc = EscEmulator(config.esc, clock, plant, lambda now: self.pulse_us(config.esc.channel, now))

    async def run(self, end: DeviceEnd) -> None:
        """Serve the bus, and run the speed controller from its pulses."""
        async with asyncio.TaskGroup() as group:
            group.create_task(self._esc.run())
            await super().run(end)


def emulated(setup: EmulatorSetup) -> Pca9685Emulator:
    """Create a simulated robot's servo controller."""
    config: Pca9685Config = setup.settings or Pca9685Config()
    return Pca9685Emulator(
        setup.clock,
        setup.physics.servos,
        address=config.address,
        oscillator=config.oscillator,
        seed=setup.seed,
    )


def emulated_esc(setup: EmulatorSetup) -> Pca9685EscEmulator:
    """Create a simulated robot's servo and speed controller."""
    return Pca9685EscEmulator(
        setup.clock, setup.physics.motors[0], setup.physics.servos, setup.settings, seed=setup.seed
    )
