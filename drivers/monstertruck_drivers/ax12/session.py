"""Requests and replies on the half-duplex bus over one open link; shared by the driver and `identify`."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Final

from monstertruck_drivers.ax12 import protocol
from monstertruck_drivers.ax12.protocol import Alarm, Ax12Parser, Packet, Register, alarm_names
from monstertruck_drivers.link import Link
from monstertruck_runtime.clock import SECOND, Clock
from monstertruck_runtime.errors import DeviceTimeoutError, ProtocolError

RETRIES: Final = 2


@dataclass(frozen=True, slots=True)
class Answer:
    """Contents of a status packet."""

    error: Alarm
    data: bytes


class Ax12Session:
    """One session; only the host initiates exchanges.

    A passive adapter echoes every sent byte. An echoed request looks like a valid status packet. The session therefore
    determines once whether the adapter echoes, using a request that no answer resembles, and then drops the echo in
    each exchange.

    Args:
        link: open link to the adapter.
        clock: time.
        timeout: returns the timeout (s) for exchanging a number of bytes at a baud rate.
    """

    def __init__(self, link: Link, clock: Clock, timeout: Callable[[int, int], float]) -> None:
        self.echo = False
        self.strange = 0
        """Number of received bytes outside correct packets."""
        self._link = link
        self._clock = clock
        self._timeout = timeout
        self.baud = link.baud or protocol.AX12_BAUD
        """Baud rate of the line."""
        self._quiet_until = 0
        self._behind: dict[int, int] = {}
        """Data length of the answer to a read that may still arrive, by unit: the next read could take it for its
        own.
        """

    async def find_echo(self, *units: int) -> None:
        """Determine whether the adapter echoes; any of ``units`` may be absent.

        Raises:
            DeviceLostError: the adapter was unplugged.
        """
        for unit in units:
            # The answer contains three bytes, its echo two.
            request = protocol.read(unit, protocol.MODEL_NUMBER, 3)
            heard = await self._exchange(request, 3, lambda packet: len(packet.params) in (2, 3))
            if heard is not None:
                self.echo = heard.encode() == request
                return

    async def ping(self, unit: int, retries: int = RETRIES) -> Alarm:
        """Ping a unit; return its error bits.

        Raises:
            DeviceLostError: the adapter was unplugged.
            DeviceTimeoutError: no answer, or no valid one.
        """
        return (await self._ask(unit, protocol.ping(unit), 0, retries)).error

    async def read(self, unit: int, start: Register, count: int, retries: int = RETRIES) -> Answer:
        """Read ``count`` bytes of the control table.

        Raises:
            DeviceLostError: the adapter was unplugged.
            DeviceTimeoutError: no answer, or no valid one.
            ProtocolError: the unit refused.
        """
        return await self._ask(unit, protocol.read(unit, start, count), count, retries)

    async def write(self, unit: int, start: Register, data: bytes, retries: int = RETRIES) -> Alarm:
        """Write to the control table and wait for the answer.

        Raises:
            DeviceLostError: the adapter was unplugged.
            DeviceTimeoutError: no answer, or no valid one.
            ProtocolError: the unit refused.
        """
        answer = await self._ask(unit, protocol.write(unit, start, data), 0, retries)
        refused = answer.error & (Alarm.ANGLE | Alarm.RANGE | Alarm.CHECKSUM | Alarm.INSTRUCTION)
        if refused:
            raise ProtocolError(
                f"{self._link.name}: unit {unit} refused a write to {start.address}: {alarm_names(refused)} error"
            )
        return answer.error

    async def sync_write(self, start: Register, data: Mapping[int, bytes]) -> None:
        """Write to several units in one packet; there is no answer.

        Raises:
            DeviceLostError: the adapter was unplugged.
        """
        await self._clock.sleep_until(self._quiet_until)
        packet = protocol.sync_write(start, data)
        self._link.write(packet)
        gap = 100e-6  # seconds between a packet without an answer and the next packet
        self._quiet_until = self._clock.now() + round((len(packet) * 10 / self.baud + gap) * SECOND)

    async def _ask(self, unit: int, request: bytes, count: int, retries: int) -> Answer:
        def wanted(packet: Packet) -> bool:
            refused = not packet.params and packet.code
            return packet.unit == unit and (len(packet.params) == count or bool(refused))

        for attempt in range(1 + retries):
            if unit in self._behind and not await self._catch_up(unit):
                continue
            packet = await self._exchange(request, count, wanted)
            if packet is None:
                if count:
                    self._behind[unit] = count
                continue
            error = Alarm(packet.code)
            if packet.code and Alarm.CHECKSUM in error and attempt < retries:
                continue
            if len(packet.params) != count:
                raise ProtocolError(f"{self._link.name}: unit {unit} gave no data: {alarm_names(error)} error")
            return Answer(error, packet.params)
        raise DeviceTimeoutError(f"{self._link.name}: unit {unit}: no correct answer")

    async def _catch_up(self, unit: int) -> bool:
        """Send a ping and wait for its answer: answers arrive in order, so any late ones arrive before it."""

        def wanted(packet: Packet) -> bool:
            return packet.unit == unit and not packet.params

        if await self._exchange(protocol.ping(unit), self._behind[unit], wanted) is None:
            return False
        del self._behind[unit]
        return True

    async def _exchange(self, request: bytes, count: int, wanted: Callable[[Packet], bool]) -> Packet | None:
        """Send a request; return the first matching packet, or None on timeout.

        Args:
            request: encoded packet.
            count: number of data bytes in the answer.
            wanted: distinguishes the answer from late answers to earlier requests.
        """
        await self._clock.sleep_until(self._quiet_until)
        self._link.discard()
        self._link.write(request)
        # A damaged length must not make the parser wait for more bytes than the answer has.
        parser = Ax12Parser(longest=max(len(request) - 4, count + 2))
        echo_due = self.echo
        end = self._clock.now() + round(self._timeout(len(request) + 6 + count, self.baud) * SECOND)
        while (left := end - self._clock.now()) > 0:
            try:
                data = await self._link.read(left / SECOND)
            except TimeoutError:
                return None
            self.strange += len(data)
            for packet in parser.feed(data):
                self.strange -= len(packet.params) + 6
                if echo_due and packet.encode() == request:
                    echo_due = False
                elif wanted(packet):
                    return packet
        return None
