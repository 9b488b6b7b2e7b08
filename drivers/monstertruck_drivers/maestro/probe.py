"""Identify a Maestro on the port and read its channels, without motion."""

from monstertruck_drivers.link import Port
from monstertruck_drivers.maestro.config import MaestroConfig
from monstertruck_drivers.maestro.esc_config import MaestroEscConfig
from monstertruck_drivers.maestro.protocol import CHANNELS, Encoder, error_names
from monstertruck_drivers.maestro.session import MaestroSession
from monstertruck_runtime.clock import Clock


async def probe(port: Port, clock: Clock, settings: MaestroConfig | None = None) -> dict[str, object]:
    """Identify a Maestro by compact commands without CRC, and read all channels.

    Only positions and the error word are read; reading clears the errors.

    Returns:
        JSON-able: ``device``, ``port``, ``errors`` pending before, ``channels``: per channel the pulse being
        sent in microseconds (0 = off) were it a servo, and the voltage at the pin were it an input.

    Raises:
        DeviceLostError: not plugged in.
        DeviceTimeoutError: silence; the text says what to check.
        WrongDeviceError: another device.
        PortBusyError: another process holds the port.
    """
    async with await port.open() as link:
        session = MaestroSession(link, clock, Encoder(), timeout=0.3)
        errors = await session.identify(0, 1)
        positions = await session.ask(*(session.encode.get_position(channel) for channel in range(CHANNELS)))
    return {
        "device": "Pololu Micro Maestro",
        "port": port.name,
        "errors": error_names(errors),
        "channels": [
            {"channel": channel, "if_servo_us": word / 4, "if_input_v": round(word * 5 / 1023, 3)}
            for channel, word in enumerate(positions)
        ],
    }


async def probe_esc(port: Port, clock: Clock, settings: MaestroEscConfig | None = None) -> dict[str, object]:
    """Identify the Maestro that a speed controller hangs on; see ``probe``."""
    return await probe(port, clock, None if settings is None else settings.unit)
