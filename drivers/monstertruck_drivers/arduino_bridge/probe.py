"""Detect a board with ROSArduinoBridge and read its counters; the motor stop identifies it."""

from monstertruck_drivers.arduino_bridge.config import ArduinoBridgeConfig
from monstertruck_drivers.arduino_bridge.protocol import speeds
from monstertruck_drivers.arduino_bridge.session import BoardSession
from monstertruck_drivers.link import Port
from monstertruck_runtime.clock import Clock


async def probe(port: Port, clock: Clock, settings: ArduinoBridgeConfig | None = None) -> dict[str, object]:
    """Identity and both counters.

    Returns:
        JSON-able: ``device``, ``port``, ``counts`` left and right.

    Raises:
        DeviceError: see the driver's ``run``.
    """
    config = settings or ArduinoBridgeConfig()
    async with await port.open() as link:
        session = BoardSession(link, clock, config.answer_timeout)
        await session.identify(config.boot)
        counts = await session.exchange(speeds(0, 0))
    return {"device": "board with ROSArduinoBridge", "port": port.name, "counts": list(counts)}
