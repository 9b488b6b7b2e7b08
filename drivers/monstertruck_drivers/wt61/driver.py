"""IMU driver: converts the unit's stream into angular velocities and specific forces."""

from typing import NamedTuple

from monstertruck_drivers.inertial import corrected_force, corrected_rate, mean
from monstertruck_drivers.link import Link, Port
from monstertruck_drivers.streaming import DeviceStream
from monstertruck_drivers.wt61.config import Wt61Config
from monstertruck_drivers.wt61.protocol import RATE, TOGGLE_SLEEP, Wt61Kind, Wt61Packet, Wt61Parser
from monstertruck_runtime.clock import SECOND, Clock
from monstertruck_runtime.errors import DeviceTimeoutError, ProtocolError
from monstertruck_runtime.ports import EventSink, Publisher, Ready
from monstertruck_schemas.sensor import Imu


class ImuSample(NamedTuple):
    """Measurement at one instant."""

    force: Wt61Packet
    rate: Wt61Packet


class Wt61Session:
    """Receives from one unit.

    Args:
        link: open link.
        clock: time.
    """

    def __init__(self, link: Link, clock: Clock) -> None:
        self.parser = Wt61Parser()
        self._link = link
        self._stream = DeviceStream(link, clock, lambda data: self._samples(self.parser.feed(data)))
        self._acceleration: Wt61Packet | None = None

    async def receive(self, within: float) -> list[ImuSample]:
        """Return the completed samples; raises the same errors as ``DeviceStream.receive``."""
        return await self._stream.receive(within)

    def _samples(self, packets: list[Wt61Packet]) -> list[ImuSample]:
        samples = []
        for packet in packets:
            if packet.kind is Wt61Kind.ACCELERATION:
                self._acceleration = packet
            elif packet.kind is Wt61Kind.ANGULAR_VELOCITY and self._acceleration is not None:
                samples.append(ImuSample(self._acceleration, packet))
                self._acceleration = None
        return samples

    async def start(self) -> list[ImuSample]:
        """Wait for packets from a unit that may be in standby.

        Raises:
            DeviceLostError: the unit was unplugged.
            DeviceTimeoutError: the unit is silent.
            WrongDeviceError: bytes arrive, but no WT61 packet.
        """
        for remedy in (b"", TOGGLE_SLEEP):
            if remedy:
                self._link.write(remedy)
            try:
                # 0.6: seconds to receive a packet of a streaming unit; it needs half of one after power-up
                return await self._stream.first(0.6, "of a WT61: another device, or another baud rate")
            except DeviceTimeoutError:
                continue
        raise DeviceTimeoutError(f"{self._link.name}: silent; expected a WT61 that streams")


class Wt61Driver:
    """Receives the unit's stream; a silent unit is woken up once.

    Args:
        config: averaging and check settings.
        port: the unit's port.
        clock: time.
        out: measurements, in the unit's own axes.
        events: not used.
        name: name of the service and of the frame.
    """

    def __init__(
        self,
        config: Wt61Config,
        port: Port,
        clock: Clock,
        out: Publisher[Imu],
        events: EventSink,
        name: str = "imu",
    ) -> None:
        self.name = name
        self._config = config
        self._port = port
        self._clock = clock
        self._out = out

    async def run(self, ready: Ready) -> None:
        """Serve one session.

        Raises:
            DeviceLostError: the unit was unplugged.
            DeviceTimeoutError: the unit is silent.
            ProtocolError: bytes arrive without a measurement, or a measurement repeats.
            WrongDeviceError: the first bytes contain no WT61 packet.
            PortBusyError: another process holds the port.
        """
        async with await self._port.open() as link:
            session = Wt61Session(link, self._clock)
            samples = await session.start()
            ready()
            kept: list[ImuSample] = []
            last: ImuSample | None = None
            equal = 0
            while True:
                for sample in samples:
                    equal, last = equal + 1 if sample == last else 0, sample
                    kept.append(sample)
                    if len(kept) >= self._config.average:
                        self._publish(kept)
                        kept = []
                if equal >= self._config.stuck_after:
                    raise ProtocolError(f"{link.name}: {equal} measurements in a row are identical")
                samples = await session.receive(self._config.silence)

    def _publish(self, samples: list[ImuSample]) -> None:
        received = self._clock.now()
        middle = (len(samples) - 1) * SECOND // (2 * RATE)
        correction = self._config.correction
        self._out.put(
            Imu(
                stamp=received - round(self._config.delay * SECOND) - middle,
                received=received,
                seq=self._out.next_seq(),
                frame=self.name,
                angular_velocity=corrected_rate(mean([rate.angular_velocity for _, rate in samples]), correction),
                linear_acceleration=corrected_force(mean([force.acceleration for force, _ in samples]), correction),
                temperature=samples[-1][0].celsius,
            )
        )


async def identify(link: Link, clock: Clock, settings: Wt61Config) -> dict[str, object]:
    """Wait for one measurement.

    Returns:
        JSON-compatible dict: ``angular_velocity`` (rad/s), ``acceleration`` (m/s^2), ``temperature_c``.

    Raises:
        DeviceError: the same errors as from the driver's ``run``.
    """
    force, rate = (await Wt61Session(link, clock).start())[-1]
    return {
        "angular_velocity": rate.angular_velocity,
        "acceleration": force.acceleration,
        "temperature_c": force.celsius,
    }
