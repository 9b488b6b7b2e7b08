"""Emulated EPOS 24/1, byte for byte, with faults on request.

It keeps its last speed when the host goes silent, because there is no host watchdog over RS232.
"""

import asyncio
from collections import deque
from contextlib import suppress

import numpy as np

from monstertruck_drivers.cable import DeviceEnd
from monstertruck_drivers.disobedience import USAGE, DisobedientMotor
from monstertruck_drivers.emulation import EmulatorSetup, MotorPlant
from monstertruck_drivers.epos import objects as od
from monstertruck_drivers.epos.firmware import AccessRefusedError, Firmware, FreeMotor
from monstertruck_drivers.epos.protocol import (
    ANSWER,
    EPOS_BAUD,
    MAX_WORDS,
    READY,
    REFUSED,
    Frame,
    FrameError,
    NmtCommand,
    ObjectSegment,
    Opcode,
    State,
    answer,
    body_size,
    decode_body,
    join,
    split,
)
from monstertruck_drivers.fault_table import FaultTable, FaultyDevice
from monstertruck_runtime.clock import SECOND, Clock
from monstertruck_schemas.roles import SHAFTS, DeviceRole

FAULT_NAMES = {
    "over_current": od.OVER_CURRENT,
    "over_voltage": od.OVER_VOLTAGE,
    "under_voltage": od.UNDER_VOLTAGE,
    "encoder": od.POSITION_SENSOR,
    "following": od.FOLLOWING_ERROR,
}


class EposEmulator(FaultyDevice):
    """Emulated controller; set ``end.baud = 38400`` for real exchange times.

    Faults (``inject``): ``fault CODE|NAME [passing]``: into FAULT; the cause stays until ``clear`` unless passing.
    ``busy``, ``refuse``, ``flip``, ``stray`` ``[COUNT]``: opcodes refused, frames refused, answers with a wrong bit,
    bytes before acknowledges. ``acknowledge``, ``length`` ``[COUNT]``: acknowledges, and length bytes from the host,
    damaged on the line. ``restart [COUNT]``: the supply fails briefly before the next answers. ``delay MS [COUNT]``:
    late answers. ``silent``, ``power``, ``line`` (quick stop input), ``strict`` (impossible controlwords are errors),
    ``repeat`` (refused answers come again), ``latch`` (quick stop is left through power stage off only): ``on|off``.
    ``supply_limit VOLTS``: supply voltage above which the over-voltage fault occurs. ``runaway``: see
    ``DisobedientMotor``.

    Args:
        clock: time.
        motor: shaft and load; None for an unloaded motor of its own.
        seed: seed for delays and noise.
        node: the controller's node id (it also answers to 0).
    """

    def __init__(self, clock: Clock, motor: MotorPlant | None = None, *, seed: int = 0, node: int = 1) -> None:
        self.name = "epos"
        self.firmware = Firmware(clock.now, motor or FreeMotor(), np.random.default_rng(seed))
        self.signals = self.firmware.signals
        self.received: deque[tuple[int, bytes]] = deque(maxlen=4096)
        """Latest bytes from the host with their times."""
        self.frames: deque[tuple[int, Frame]] = deque(maxlen=1024)
        """Latest frames accepted from the host."""
        self.repeat_refused = False
        """Whether an answer rejected by the host is repeated (undocumented for the real controller)."""
        self._clock = clock
        self._node = node
        self._inbox = bytearray()
        self._power = True
        self._powered: asyncio.Timeout | None = None
        self._booted_at = 0
        self._delay, self._delayed = 0.0, 0
        """Additional delay of answers (s), and the number of delayed answers."""
        self._long: tuple[bytes, bool] = (b"", False)
        self.faults = FaultTable(
            self.name,
            {
                "fault CODE|NAME [passing]": self._inject_fault,
                "clear": self._inject_clear,
                "power on|off": self._switch_power,
                "busy|refuse|flip|stray|acknowledge|length|restart [COUNT]": 0,
                "delay MILLISECONDS [COUNT]": self._inject_delay,
                "silent on|off": False,
                "line on|off": self.set_quick_stop_input,
                "supply_limit VOLTS": self._inject_supply_limit,
                "strict on|off": self._inject_strict,
                "repeat on|off": self._inject_repeat,
                "latch on|off": self._inject_latch,
                f"runaway {USAGE}": lambda *words: self.firmware.run_away(DisobedientMotor.parse(*words)),
            },
        )

    # Faults and switches

    def power_cycle(self) -> None:
        """Switch the supply off and on: it returns in "switch-on disabled", with target 0 and stored settings."""
        self._switch_power(False)
        self._switch_power(True)

    def set_quick_stop_input(self, active: bool) -> None:
        """Set the hardware deadman line at the digital input: while it is active, the controller stops the motor."""
        self.firmware.set_quick_stop_input(active)

    def _inject_fault(self, name: str, *passing: str) -> None:
        code = FAULT_NAMES[name] if name in FAULT_NAMES else int(name, 16)
        if passing not in ((), ("passing",)):
            raise ValueError(passing)
        if not passing:
            self.firmware.causes.add(code)
        if self._power:
            self.firmware.advance()
            self.firmware.fail(code)

    def _inject_clear(self) -> None:
        self.firmware.causes.clear()

    def _inject_delay(self, milliseconds: str, count: str | None = None) -> None:
        self._delay = float(milliseconds) / 1000
        self._delayed = 1 << 62 if count is None else int(count)

    def _inject_supply_limit(self, volts: str) -> None:
        self.firmware.over_voltage_above = float(volts)

    def _inject_strict(self, on: bool) -> None:
        self.firmware.strict_transitions = on

    def _inject_repeat(self, on: bool) -> None:
        self.repeat_refused = on

    def _inject_latch(self, on: bool) -> None:
        self.firmware.latched_quick_stop = on

    def _switch_power(self, on: bool) -> None:
        if self._power and not on:
            self.firmware.shut_down()
        elif on and not self._power:
            self.firmware.boot()
            self._booted_at = self._clock.now() + int(0.4 * SECOND)  # time from power-up to the first answer
        self._power = on
        if self._powered is not None and not self._powered.expired():  # an exchange in progress ends here
            self._powered.reschedule(0)

    def _delays(self) -> bool:
        if self._delayed <= 0:
            return False
        self._delayed -= 1
        return True

    # The line

    async def run(self, end: DeviceEnd) -> None:
        """Serve until cancelled."""
        watch = asyncio.create_task(self._watch())
        try:
            while True:
                with suppress(TimeoutError):
                    async with asyncio.timeout(None) as self._powered:
                        await self._serve(end)
        finally:
            self._powered = None
            watch.cancel()
            with suppress(asyncio.CancelledError):
                await watch

    async def _watch(self) -> None:
        """Simulate the controller between requests: supply faults stop the motor."""
        while True:
            await self._clock.sleep(0.05)  # seconds between checks of the supply without requests
            if self._power:
                self.firmware.advance()

    async def _serve(self, end: DeviceEnd) -> None:
        self._inbox.clear()
        while True:
            opcode = (await self._take(end, 1))[0]
            try:
                await self._exchange(end, opcode)
            except TimeoutError:  # an incomplete frame is dropped silently
                self._inbox.clear()

    async def _exchange(self, end: DeviceEnd, opcode: int) -> None:
        if self.faults.strikes("busy"):
            self._send(end, bytes((REFUSED,)))
            return
        self._acknowledge(end)
        head = await self._within(end, 1)
        if self.faults.strikes("length"):
            head = bytes((head[0] ^ 0x20,))
        body = head + await self._within(end, body_size(head[0]))
        try:
            request = decode_body(opcode, body)
        except FrameError:
            request = None
        if request is None or len(request.words) > MAX_WORDS or self.faults.strikes("refuse"):
            self._send(end, bytes((REFUSED,)))
            return
        self.frames.append((self._clock.now(), request))
        if opcode == Opcode.NMT:
            self._acknowledge(end)
            self._network(request)
            return
        reply = self._execute(request)
        self._acknowledge(end)
        await self._reply(end, reply)

    async def _reply(self, end: DeviceEnd, reply: Frame) -> None:
        if self.faults.strikes("restart"):
            self.power_cycle()
        if self._delays():
            await self._clock.sleep(self._delay)
        end.write(bytes((ANSWER,)))
        if (await self._within(end, 1))[0] != READY:
            return
        body = reply.body
        if self.faults.strikes("flip"):
            body = body[:-3] + bytes((body[-3] ^ 0x10,)) + body[-2:]
        self._send(end, body)
        if (await self._within(end, 1))[0] == REFUSED and self.repeat_refused:
            self._send(end, reply.body)
            await self._within(end, 1)

    def _acknowledge(self, end: DeviceEnd) -> None:
        if self.faults.strikes("stray"):
            end.write(b"\xa5")
        self._send(end, bytes((READY ^ 0x10 if self.faults.strikes("acknowledge") else READY,)))

    def _send(self, end: DeviceEnd, data: bytes) -> None:
        # Seconds from the last byte received to the first one sent; most of it is the host's USB converter.
        turn_around = 0.001
        end.write(data, turn_around)

    async def _within(self, end: DeviceEnd, count: int) -> bytes:
        """Read the bytes of a frame; an overlong pause raises ``TimeoutError``."""
        return await self._take(end, count, self.firmware.frame_timeout)

    async def _take(self, end: DeviceEnd, count: int, pause: float | None = None) -> bytes:
        while len(self._inbox) < count:
            data = await end.read(pause)
            if self._power and not self.faults["silent"] and self._clock.now() >= self._booted_at:
                self.received.append((self._clock.now(), data))
                self._inbox += data
        taken = bytes(self._inbox[:count])
        del self._inbox[:count]
        return taken

    # Services

    def _execute(self, request: Frame) -> Frame:
        try:
            match request.opcode, request.words:
                case Opcode.READ, (index, address):
                    return answer(0, *split(self.firmware.read(index, self._sub(address))))
                case Opcode.WRITE, (index, address, low, high):
                    self.firmware.write(index, self._sub(address), join(low, high))
                    return answer()
                case Opcode.INITIATE_SEGMENTED_READ, (index, address):
                    self._long = self.firmware.read_long(index, self._sub(address)), False
                    return answer()
                case Opcode.SEGMENTED_READ, (control,):
                    return answer(0, *self._segment(bool(control & 0x40)).words)
        except AccessRefusedError as error:
            return answer(error.code)
        return answer(od.ILLEGAL_COMMAND)

    def _sub(self, address: int) -> int:
        if address >> 8 not in (0, self._node):
            raise AccessRefusedError(od.WRONG_NODE)
        return address & 0xFF

    def _segment(self, toggle: bool) -> ObjectSegment:
        data, expected = self._long
        if toggle is not expected:
            raise AccessRefusedError(od.TOGGLE_ERROR)
        segment_bytes = 4
        self._long = data[segment_bytes:], not toggle
        return ObjectSegment(data[:segment_bytes], toggle, len(data) > segment_bytes)

    def _network(self, request: Frame) -> None:
        if request.words in ((0, NmtCommand.RESET_NODE), (self._node, NmtCommand.RESET_NODE)):
            self.power_cycle()

    @property
    def state(self) -> State:
        """Power state as of the latest update."""
        return self.firmware.state


def emulated(setup: EmulatorSetup) -> EposEmulator:
    """Create the controller for one driven shaft of a simulated truck, with a realistic line speed."""
    shaft = SHAFTS.index(DeviceRole(setup.role))
    setup.port.device.baud = EPOS_BAUD
    return EposEmulator(setup.clock, setup.physics.motors[shaft], seed=setup.seed + shaft)
