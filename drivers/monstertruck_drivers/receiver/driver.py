"""Receiver driver: converts channels into requests from the operator next to the robot."""

from collections import deque
from typing import Final

from monstertruck_drivers.link import Link, Port
from monstertruck_drivers.receiver.config import CrsfConfig, ReceiverConfig
from monstertruck_drivers.receiver.crsf import CrsfParser
from monstertruck_drivers.receiver.frames import ReceiverFrame, ReceiverParser
from monstertruck_drivers.receiver.protocol import ChannelWords, position
from monstertruck_drivers.receiver.sbus import SbusParser
from monstertruck_drivers.streaming import DeviceStream
from monstertruck_runtime.clock import SECOND, Clock
from monstertruck_runtime.errors import DeviceTimeoutError, ProtocolError
from monstertruck_runtime.ports import EventSink, Publisher, Ready
from monstertruck_schemas.event import Severity
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.sensor import HandControls

PERIOD: Final = SECOND // 50
"""Time between two messages (ns); a change of the switches or of the link is published at once."""


def parser_of(config: ReceiverConfig) -> ReceiverParser:
    """Return the parser for the receiver's protocol."""
    return CrsfParser() if isinstance(config, CrsfConfig) else SbusParser()


class Hand:
    """State of the radio control, accumulated from frames; performs no I/O.

    Args:
        config: meaning of the channels.
    """

    def __init__(self, config: ReceiverConfig) -> None:
        self._config = config
        self._channels: ChannelWords | None = None
        self._heard = 0
        """Arrival time of the latest channels (ns)."""
        self._on: dict[int, int] = {}
        """Consecutive frames with the switch on, by channel."""
        self._failsafe = False
        self._quality: float | None = None
        self._rssi: float | None = None
        recent = 100  # frames over which the link quality is computed if the receiver does not report it
        self._missed: deque[bool] = deque(maxlen=recent)

    def take(self, frame: ReceiverFrame, now: int) -> None:
        """Process one frame that arrived at ``now``."""
        if frame.quality is not None:
            self._quality, self._rssi, self._failsafe = frame.quality, frame.rssi, frame.failsafe
        if frame.channels is None:
            return
        if frame.quality is None and self._rssi is None:
            self._missed.append(frame.lost)
            self._failsafe = frame.failsafe
        if frame.failsafe or frame.lost:
            return
        self._channels, self._heard = frame.channels, now
        for channel, raw in enumerate(frame.channels, 1):
            on = self._position(channel, raw) > 0.5  # position above which a switch is on
            self._on[channel] = self._on.get(channel, 0) + 1 if on else 0

    def lost(self, now: int) -> bool:
        """Whether the transmitter is lost."""
        silent = self._channels is None or now - self._heard > self._config.silence * SECOND
        return silent or self._failsafe

    def controls(self, now: int, seq: int, frame: str) -> HandControls:
        """Return the operator's requests; neutral while the transmitter is lost."""
        config, lost = self._config, self.lost(now)
        quality = self._quality
        if quality is None and self._missed:
            quality = 1.0 - sum(self._missed) / len(self._missed)
        return HandControls(
            stamp=self._heard or now,
            received=now,
            seq=seq,
            frame=frame,
            lost=lost,
            speed=0.0 if lost else self._stick(config.speed),
            steer=0.0 if lost else self._stick(config.steer),
            arm=not lost and self._switch(config.arm),
            drive=not lost and (config.drive is None or self._switch(config.drive)),
            estop=not lost and config.estop is not None and self._switch(config.estop),
            unseen=not lost and config.unseen is not None and self._switch(config.unseen),
            link_quality=quality,
            rssi=self._rssi,
        )

    def _position(self, channel: int, raw: int) -> float:
        return position(raw) * (-1 if channel in self._config.inverted else 1)

    def _stick(self, channel: int) -> float:
        assert self._channels is not None
        value = self._position(channel, self._channels[channel - 1])
        return 0.0 if abs(value) < self._config.dead_band else value

    def _switch(self, channel: int) -> bool:
        return self._on.get(channel, 0) >= self._config.settle


class ReceiverDriver:
    """Receives frames and publishes hand controls.

    Args:
        config: protocol and channels.
        port: the receiver's port.
        clock: time.
        out: the operator's requests, sent at 50 Hz even while the transmitter is lost.
        events: loss and return of the transmitter.
        name: service name.
    """

    def __init__(
        self,
        config: ReceiverConfig,
        port: Port,
        clock: Clock,
        out: Publisher[HandControls],
        events: EventSink,
        name: str = "hand",
    ) -> None:
        self.name = name
        self._config = config
        self._port = port
        self._clock = clock
        self._out = out
        self._events = events
        self._said: bool | None = None
        """Last reported state of the transmitter, True = lost; None before the first report."""

    async def run(self, ready: Ready) -> None:
        """Serve one session.

        Raises:
            DeviceLostError: the receiver was unplugged.
            DeviceTimeoutError: the receiver is silent.
            ProtocolError: bytes arrive without a valid frame.
            WrongDeviceError: the first bytes contain no frame.
            PortBusyError: another process holds the port.
        """
        async with await self._port.open() as link:
            stream = DeviceStream(link, self._clock, parser_of(self._config).feed)
            frames = await first_frames(stream, self._config)
            ready()
            hand, heard = Hand(self._config), self._clock.now()
            newest: HandControls | None = None
            while True:
                for frame in frames:
                    hand.take(frame, self._clock.now())
                newest = self._publish(hand, newest)
                try:
                    frames = await stream.receive(PERIOD / SECOND)
                    heard = self._clock.now()
                except (DeviceTimeoutError, ProtocolError):
                    frames = []
                    if self._clock.now() - heard > 1.0 * SECOND:  # timeout without a byte (s)
                        raise

    def _publish(self, hand: Hand, newest: HandControls | None) -> HandControls:
        """Publish when a message is due or a switch or the link has changed; return the latest message."""
        now = self._clock.now()
        controls = hand.controls(now, self._out.next_seq(), self.name)
        if newest is not None and now - newest.received < PERIOD and controls.switches == newest.switches:
            return newest
        self._out.put(controls)
        if controls.lost is not self._said:
            reason, severity = (
                (Reason.DEVICE_LOST, Severity.WARNING) if controls.lost else (Reason.DEVICE_READY, Severity.INFO)
            )
            text = "the radio control is lost" if controls.lost else "the radio control is connected"
            self._events(reason, severity, self.name, text, link_quality=controls.link_quality, rssi=controls.rssi)
            self._said = controls.lost
        return controls


async def first_frames(stream: DeviceStream[ReceiverFrame], config: ReceiverConfig) -> list[ReceiverFrame]:
    """Wait for the first frames of a session. Raises the same errors as ``DeviceStream.first``."""
    # Seconds to receive a frame at the start; a receiver without its transmitter sends link statistics only.
    listen = 1.0
    hint = "another protocol or baud rate" if isinstance(config, CrsfConfig) else "is the signal inverted?"
    return await stream.first(listen, f"of a receiver: {hint}")


async def identify(link: Link, clock: Clock, settings: ReceiverConfig) -> dict[str, object]:
    """Listen for half a second.

    Returns:
        JSON-compatible dict: ``channels`` from -1 to 1 (None without a transmitter), ``failsafe``, ``link_quality``,
        ``rssi_dbm``.

    Raises:
        DeviceError: the same errors as from the driver's ``run``.
    """
    look = 0.5  # duration of the frame collection (s)
    stream = DeviceStream(link, clock, parser_of(settings).feed)
    frames = await first_frames(stream, settings)
    until = clock.now() + round(look * SECOND)
    while clock.now() < until:
        try:
            frames += await stream.receive(look)
        except (DeviceTimeoutError, ProtocolError):
            break
    channels = next((frame.channels for frame in reversed(frames) if frame.channels is not None), None)
    link_frame = next((frame for frame in reversed(frames) if frame.quality is not None), None)
    return {
        "channels": None if channels is None else [round(position(raw), 3) for raw in channels],
        "failsafe": frames[-1].failsafe,
        "link_quality": None if link_frame is None else link_frame.quality,
        "rssi_dbm": None if link_frame is None else link_frame.rssi,
    }
