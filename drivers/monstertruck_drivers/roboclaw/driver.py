"""Encoder service: publishes the encoder counts of two wheels as ``sensor/encoders``."""

from monstertruck_drivers.link import Port
from monstertruck_drivers.roboclaw.config import RoboclawConfig
from monstertruck_drivers.roboclaw.protocol import step
from monstertruck_drivers.roboclaw.session import RoboclawSession
from monstertruck_drivers.transaction import Misses
from monstertruck_runtime.clock import SECOND, Clock, Lead, Schedule
from monstertruck_runtime.errors import DeviceRestartedError
from monstertruck_runtime.ports import EventSink, Publisher, Ready
from monstertruck_schemas.event import Severity
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.sensor import WheelEncoders


class RoboclawDriver:
    """Reads both counters and accumulates their counts across restarts of the unit, so that a position never jumps.

    Args:
        config: see ``RoboclawConfig``.
        port: the controller's port.
        clock: time.
        out: wheel angles.
        events: the unit's identity and restarts.
        name: service name.
    """

    def __init__(
        self,
        config: RoboclawConfig,
        port: Port,
        clock: Clock,
        out: Publisher[WheelEncoders],
        events: EventSink,
        name: str = "encoders",
    ) -> None:
        self.name = name
        self._config = config
        self._port = port
        self._clock = clock
        self._out = out
        self._events = events
        self._turned = [0, 0]
        """Accumulated counts of inputs 1 and 2 since the driver was created."""

    async def run(self, ready: Ready) -> None:
        """Serve one session.

        Raises:
            DeviceLostError: the unit was unplugged.
            DeviceRestartedError: the unit restarted and is counting from 0.
            DeviceTimeoutError, ProtocolError: no usable answers.
            WrongDeviceError: another device answers.
            PortBusyError: another process holds the port.
        """
        config = self._config
        async with await self._port.open() as link:
            session = RoboclawSession(link, self._clock, config.address, config.answer_timeout)
            self._events(Reason.DEVICE_READY, Severity.INFO, self.name, await session.identify())
            schedule = Schedule(self._clock, config.rate, Lead.POLLING)
            last: tuple[tuple[int, int], int] | None = None
            misses = Misses()
            while True:
                await schedule.next()
                asked = self._clock.now()
                with misses:
                    counts = await session.counts()
                if misses.count:
                    continue
                stamp = (asked + self._clock.now()) // 2
                if last is None:
                    ready()
                else:
                    self._count(last[0], counts, (stamp - last[1]) / SECOND)
                last = counts, stamp
                self._publish(stamp)

    def _count(self, before: tuple[int, int], now: tuple[int, int], dt: float) -> None:
        """Accumulate the counts from ``dt`` seconds.

        Raises:
            DeviceRestartedError: the change exceeds what the wheels can turn in that time.
        """
        steps = [step(old, new) for old, new in zip(before, now, strict=True)]
        if max(map(abs, steps)) * self._config.count > self._config.max_rate * dt:
            text = (
                f"{self._port.name}: counters jumped by {steps[0]} and {steps[1]}: the controller restarted "
                "its counters"
            )
            self._events(Reason.DEVICE_RESTARTED, Severity.WARNING, self.name, text)
            raise DeviceRestartedError(text)
        self._turned = [turned + by for turned, by in zip(self._turned, steps, strict=True)]

    def _publish(self, stamp: int) -> None:
        config = self._config
        first, second = self._turned
        left, right = (first, second) if config.left == 1 else (second, first)
        self._out.put(
            WheelEncoders(
                stamp=stamp,
                received=self._clock.now(),
                seq=self._out.next_seq(),
                frame=self.name,
                left=(-left if config.left_inverted else left) * config.count,
                right=(-right if config.right_inverted else right) * config.count,
            )
        )
