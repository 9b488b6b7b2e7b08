"""Driver of the range finder."""

from monstertruck_drivers.link import Link, Port
from monstertruck_runtime.clock import SECOND, Clock
from monstertruck_runtime.errors import DeviceTimeoutError, WrongDeviceError
from monstertruck_runtime.ports import EventSink, Publisher, Ready
from truck_sonar.config import Mb7360Config
from truck_sonar.message import SonarRange
from truck_sonar.protocol import BAUD, FARTHEST, Parser

DELAY = round(6 * 10 / BAUD * SECOND)
"""Transmission time of a line (ns); the device measures before the first byte."""


async def readings(link: Link, parser: Parser, timeout: float, clock: Clock) -> list[int]:
    """Wait for the next readings and return at least one.

    Raises:
        DeviceLostError: The device was unplugged.
        DeviceTimeoutError: The device is silent.
        WrongDeviceError: The device sends bytes without a valid reading.
    """
    heard = 0
    try:
        async with clock.deadline(timeout):
            while True:
                data = await link.read()
                heard += len(data)
                if found := parser.feed(data):
                    return found
    except TimeoutError:
        if heard:
            raise WrongDeviceError(f"{link.name}: {heard} bytes, but no reading of an MB7360") from None
        raise DeviceTimeoutError(f"{link.name}: silent for {timeout} s") from None


class Mb7360Driver:
    """Publishes the readings of an MB7360, which needs no configuration.

    Args:
        config: Settings.
        port: Serial port of the device.
        clock: Clock for stamps and timeouts.
        out: Publisher of the distances.
        events: Not used.
        name: Name of the service and of the sensor frame.
    """

    def __init__(
        self,
        config: Mb7360Config,
        port: Port,
        clock: Clock,
        out: Publisher[SonarRange],
        events: EventSink,
        name: str = "ranger",
    ) -> None:
        self.name = name
        self._config = config
        self._port = port
        self._clock = clock
        self._out = out

    async def run(self, ready: Ready) -> None:
        """Serve one session.

        Raises:
            DeviceLostError: The device was unplugged.
            DeviceTimeoutError: The device is silent.
            WrongDeviceError: The device sends bytes without a valid reading.
            PortBusyError: Another process holds the port.
        """
        async with await self._port.open() as link:
            parser = Parser()
            self._publish(await readings(link, parser, self._config.timeout, self._clock))
            ready()
            while True:
                self._publish(await readings(link, parser, self._config.timeout, self._clock))

    def _publish(self, found: list[int]) -> None:
        received = self._clock.now()
        self._out.put(
            SonarRange(
                stamp=received - DELAY,
                received=received,
                seq=self._out.next_seq(),
                frame=self.name,
                distance=None if found[-1] >= FARTHEST else found[-1] / 1000,
            )
        )
