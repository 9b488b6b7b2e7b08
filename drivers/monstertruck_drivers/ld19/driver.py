"""LD19 driver: receives the unit's stream and publishes every revolution."""

import numpy as np

from monstertruck_drivers.ld19.config import Ld19Config
from monstertruck_drivers.ld19.protocol import (
    FULL_TURN,
    LD19_BAUD,
    LD19_SIZE,
    MODELS,
    POINT,
    POINTS,
    STAMP_TURN,
    Ld19Packet,
    Ld19Parser,
)
from monstertruck_drivers.link import Link
from monstertruck_drivers.scanning.clock_map import ClockMap
from monstertruck_drivers.scanning.driver import ScannerDriver
from monstertruck_drivers.scanning.publishing import publish
from monstertruck_drivers.scanning.turns import BeamSamples, TurnCutter, on_equal_steps
from monstertruck_drivers.streaming import DeviceStream
from monstertruck_runtime.clock import SECOND, Clock
from monstertruck_runtime.errors import DeviceTimeoutError, ProtocolError
from monstertruck_runtime.ports import Ready
from monstertruck_schemas.event import Severity
from monstertruck_schemas.reasons import Reason


def packet_stream(link: Link, clock: Clock) -> DeviceStream[Ld19Packet]:
    """Return the packet stream of one session."""
    return DeviceStream(link, clock, Ld19Parser().feed, batch=4 * LD19_SIZE)


async def first_packets(stream: DeviceStream[Ld19Packet]) -> list[Ld19Packet]:
    """Wait for the first packets of a session. Raises the same errors as ``DeviceStream.first``."""
    listen = 1.5  # seconds to receive a packet at the start; a unit is silent for half a second after power-up
    return await stream.first(listen, "of an LD19: another device, or another baud rate")


class PacketSamples:
    """Converts packets to ``BeamSamples``, timed by the unit's clock since the start of the session."""

    def __init__(self) -> None:
        self.elapsed = 0
        """Elapsed time of the latest packet (ns)."""
        self._stamp: int | None = None

    def of(self, packets: list[Ld19Packet]) -> BeamSamples:
        """Return the samples of consecutive packets; drop samples of a stationary head."""
        kept, ends = [], []
        for packet in packets:
            if self._stamp is not None:
                self.elapsed += (packet.stamp - self._stamp) % STAMP_TURN * 1_000_000
            self._stamp = packet.stamp
            widest = (
                FULL_TURN // 4
            )  # maximum angle without a packet (0.01 degrees): a damaged packet, or a head that starts
            if packet.speed and 0 < packet.span < widest:
                kept.append(packet)
                ends.append(self.elapsed)
        points = np.frombuffer(b"".join(packet.points for packet in kept), POINT)
        start, span, speed = (
            np.array(values, np.float64)[:, None]
            for values in ([p.start for p in kept], [p.span for p in kept], [p.speed for p in kept])
        )
        number = np.arange(POINTS)
        each = span / (POINTS - 1)
        times = np.array(ends, np.float64)[:, None] - (POINTS - 1 - number) * each / 100 / speed * SECOND
        return BeamSamples(
            ((start + number * each) / FULL_TURN).ravel(),
            points["distance"] / 1000.0,
            points["intensity"],
            times.ravel(),
        )


class Ld19Driver(ScannerDriver[Ld19Config]):
    """Driver for an LD06, LD19 or STL-19P on a port."""

    async def run(self, ready: Ready) -> None:
        """Serve one session.

        Raises:
            DeviceLostError: the unit was unplugged.
            DeviceTimeoutError: the unit is silent, its head does not turn, or its scans have arrived late for several
                seconds.
            ProtocolError: bytes arrive without a valid packet.
            WrongDeviceError: the first bytes contain no LD19 packet.
            PortBusyError: another process holds the port.
        """
        config, sheet = self._config, MODELS[self._config.model].ranges
        async with await self._port.open() as link:
            stream, cutter, samples = packet_stream(link, self._clock), TurnCutter(), PacketSamples()
            transfer = 0.001  # seconds assumed from the end of a packet on the line to its arrival
            mapping = ClockMap(round((LD19_SIZE * 10 / LD19_BAUD + transfer) * SECOND), turn=STAMP_TURN)
            due, first = self._clock.now() + round(config.first_scan * SECOND), True
            packets, usable = await first_packets(stream), False
            while True:
                for revolution in cutter.add(samples.of(packets)) if packets else ():
                    if (turn := on_equal_steps(revolution)) is None:
                        continue
                    if first:
                        ready()
                        self._events(Reason.DEVICE_READY, Severity.INFO, self.name, MODELS[config.model].title)
                    due, first, usable = self._clock.now() + round(config.stale * SECOND), False, False
                    stamp = self._watch.stamp(mapping, packets[-1].stamp, stream.arrival, link.name)
                    publish(turn, stamp - samples.elapsed, stream.arrival, sheet, config, self._out, self.name)
                if self._clock.now() >= due:
                    raise self._stale(link.name, usable)
                packets = await stream.next(config.silence)
                usable = usable or bool(packets)

    def _stale(self, port: str, packets: bool) -> Exception:
        if packets:
            return DeviceTimeoutError(f"{port}: packets, but no complete revolution: its head does not turn")
        return ProtocolError(f"{port}: bytes, but no packet of an LD19")


async def identify(link: Link, clock: Clock, settings: Ld19Config) -> dict[str, object]:
    """Wait for one packet, which does not name the model.

    Returns:
        JSON-compatible dict: ``turns_per_second``, ``stamp_ms``, ``ranges_m``.

    Raises:
        DeviceError: the same errors as from the driver's ``run``.
    """
    packet = (await first_packets(packet_stream(link, clock)))[-1]
    return {
        "turns_per_second": packet.speed / 360,
        "stamp_ms": packet.stamp,
        "ranges_m": [distance / 1000 for distance in packet.decoded()["distance"].tolist()],
    }
