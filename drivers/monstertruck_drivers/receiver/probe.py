"""Detect a receiver on the port and read its channels."""

from monstertruck_drivers.link import Port
from monstertruck_drivers.receiver.config import CrsfConfig, ReceiverConfig, SbusConfig
from monstertruck_drivers.receiver.driver import first_frames, parser_of
from monstertruck_drivers.receiver.protocol import position
from monstertruck_drivers.streaming import DeviceStream
from monstertruck_runtime.clock import Clock
from monstertruck_runtime.errors import DeviceTimeoutError, ProtocolError


async def probe(port: Port, clock: Clock, settings: ReceiverConfig | None = None) -> dict[str, object]:
    """Listen for half a second.

    Returns:
        JSON-able: ``device``, ``port``, ``channels`` -1 to 1 (None without a transmitter), ``failsafe``,
        ``link_quality``, ``rssi_dbm``.

    Raises:
        DeviceError: see the driver's ``run``.
    """
    config = settings or CrsfConfig()
    look = 0.5  # duration of the frame collection (s)
    async with await port.open() as link:
        stream = DeviceStream(link, clock, parser_of(config).feed)
        frames = await first_frames(stream, config)
        until = clock.now() + round(look * 1e9)
        while clock.now() < until:
            try:
                frames += await stream.receive(look)
            except (DeviceTimeoutError, ProtocolError):
                break
    channels = next((frame.channels for frame in reversed(frames) if frame.channels is not None), None)
    link_frame = next((frame for frame in reversed(frames) if frame.quality is not None), None)
    return {
        "device": f"receiver ({'CRSF' if isinstance(config, CrsfConfig) else 'SBUS'})",
        "port": port.name,
        "channels": None if channels is None else [round(position(raw), 3) for raw in channels],
        "failsafe": frames[-1].failsafe,
        "link_quality": None if link_frame is None else link_frame.quality,
        "rssi_dbm": None if link_frame is None else link_frame.rssi,
    }


async def probe_sbus(port: Port, clock: Clock, settings: SbusConfig | None = None) -> dict[str, object]:
    """Listen for half a second to a receiver that speaks SBUS; see ``probe``."""
    return await probe(port, clock, settings or SbusConfig())
