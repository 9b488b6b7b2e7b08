"""Battery driver for a Linux IIO converter."""

from typing import Any

from monstertruck_drivers.battery import iio
from monstertruck_drivers.battery.config import IioConfig
from monstertruck_drivers.battery.monitor import BatteryMonitor
from monstertruck_drivers.computer import Computer
from monstertruck_drivers.transaction import Misses
from monstertruck_runtime.clock import Clock, Lead, Schedule
from monstertruck_runtime.errors import DeviceError
from monstertruck_runtime.ports import EventSink, Publisher, Ready, Subscription
from monstertruck_schemas.sensor import Battery, DriveFeedback


class IioBatteryDriver:
    """Reads one channel at a fixed rate.

    Args:
        config: pack, converter, divider.
        computer: computer with the converter; its files are read in a thread, because an I2C conversion takes
            milliseconds.
        clock: time.
        out: battery messages.
        events: changes of the battery's level.
        drive: motor feedback, whose current explains the sag; None to ignore the sag.
        name: service name.
    """

    def __init__(
        self,
        config: IioConfig,
        computer: Computer,
        clock: Clock,
        out: Publisher[Battery],
        events: EventSink,
        drive: Subscription[DriveFeedback] | None = None,
        name: str = "battery",
    ) -> None:
        self.name = name
        self._config = config
        self._clock = clock
        self._root = computer.root / iio.CONVERTERS
        self._offload = computer.machine.offload
        self._monitor = BatteryMonitor(config, out, events, name, drive)

    async def run(self, ready: Ready) -> None:
        """Serve one session.

        Raises:
            DeviceLostError: the converter is missing or has disappeared.
            DeviceMismatchError: the converter lacks the channel, or there are several converters and none is
                configured.
            DeviceTimeoutError: three consecutive readings got no answer.
            ProtocolError: three consecutive readings were not a number.
            PortBusyError: another process is streaming from it.
        """
        channel = await self._offload(self._find)
        await self._offload(channel.read)
        ready()
        schedule = Schedule(self._clock, self._config.rate, Lead.IN_THREADS)
        misses = Misses()
        while True:
            await schedule.next()
            stamp = self._clock.now()
            with misses:
                raw = await self._offload(channel.read)
            if misses.count:
                continue
            volts = channel.volts(raw) * self._config.divider + self._config.offset
            self._monitor.take(stamp, self._clock.now(), volts, at_limit=channel.at_limit(raw))

    def _find(self) -> iio.Channel:
        converter = iio.find(self._root, self._config.device)
        return iio.channel(converter, self._config.channel, self._config.full_scale)


async def identify(computer: Computer, clock: Clock, settings: IioConfig) -> dict[str, Any]:
    """Read every voltage input of every converter once.

    Returns:
        JSON-compatible dict: ``converters`` with name, path, and for each channel the reading and pin voltage, or the
        error.
    """
    root = computer.root / iio.CONVERTERS
    return await computer.machine.offload(
        lambda: {"converters": [_described(converter) for converter in iio.converters(root)]}
    )


def _described(converter: iio.Converter) -> dict[str, Any]:
    return {
        "name": converter.name,
        "path": str(converter.path),
        "channels": [_reading(converter, number) for number in converter.channels()],
    }


def _reading(converter: iio.Converter, number: int) -> dict[str, Any]:
    try:
        channel = iio.channel(converter, number)
        raw = channel.read()
    except DeviceError as error:
        return {"channel": number, "error": str(error)}
    return {"channel": number, "raw": raw, "volts": round(channel.volts(raw), 4), "full_scale": channel.full_scale}
