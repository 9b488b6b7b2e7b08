"""Is a RPLIDAR on the port, which one, and how does it scan?"""

from monstertruck_drivers.link import Port
from monstertruck_drivers.rplidar.config import RplidarConfig
from monstertruck_drivers.rplidar.session import RplidarSession
from monstertruck_runtime.clock import Clock


async def probe(port: Port, clock: Clock, settings: RplidarConfig | None = None) -> dict[str, object]:
    """Handshake; the unit is idle afterwards.

    Returns:
        JSON-able: ``device``, ``port``, ``serial``, ``firmware``, ``health``, ``modes`` by name (samples a second),
        ``typical``.

    Raises:
        DeviceError: see the driver's ``run``.
    """
    async with await port.open() as link:
        unit = await RplidarSession(link, clock, settings or RplidarConfig()).handshake()
    return {
        "device": f"SLAMTEC RPLIDAR, model 0x{unit.identity.model:02x}",
        "port": port.name,
        "serial": unit.identity.serial,
        "firmware": ".".join(map(str, unit.identity.firmware)),
        "health": unit.health.status,
        "modes": {mode.name: round(1.0 / mode.sample_time) for mode in unit.modes},
        "typical": next((mode.name for mode in unit.modes if mode.number == unit.typical), None),
    }
