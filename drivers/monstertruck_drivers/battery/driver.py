"""Battery driver on a Linux IIO converter."""

from monstertruck_drivers.battery import iio
from monstertruck_drivers.battery.config import IioConfig
from monstertruck_drivers.battery.monitor import BatteryMonitor
from monstertruck_drivers.computer import Computer
from monstertruck_drivers.transaction import Misses
from monstertruck_runtime.clock import IN_THREADS, Clock, Schedule
from monstertruck_runtime.ports import EventSink, Publisher, Ready, Subscription
from monstertruck_schemas.sensor import Battery, DriveFeedback


class IioBatteryDriver:
    """Reads one channel at a fixed rate.

    Args:
        config: pack, converter, divider.
        computer: computer with the converter; files are read off the loop, as an I2C conversion takes milliseconds.
        clock: time.
        out: battery messages.
        events: changes of the battery's level.
        drive: motor feedback, whose current explains the sag; None = unused.
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
            DeviceLostError: no such converter, or it vanished.
            DeviceMismatchError: the converter lacks the channel, or there are several and none is configured.
            DeviceTimeoutError: it does not answer, three readings in a row.
            ProtocolError: no numbers, three readings in a row.
            PortBusyError: another process streams from it.
        """
        channel = await self._offload(self._find)
        await self._offload(channel.read)
        ready()
        schedule = Schedule(self._clock, self._config.rate, IN_THREADS)
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
