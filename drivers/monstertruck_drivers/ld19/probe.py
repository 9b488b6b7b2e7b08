"""Is an LD06, LD19 or STL-19P on the port?"""

from monstertruck_drivers.ld19.config import Ld19Config
from monstertruck_drivers.ld19.driver import Ld19Session
from monstertruck_drivers.link import Port
from monstertruck_runtime.clock import Clock


async def probe(port: Port, clock: Clock, settings: Ld19Config | None = None) -> dict[str, object]:
    """Listen for one packet, which does not say the model.

    Returns:
        JSON-able: ``device``, ``port``, ``turns_per_second``, ``stamp_ms``, ``ranges_m``.

    Raises:
        DeviceError: see the driver's ``run``.
    """
    async with await port.open() as link:
        packet = (await Ld19Session(link, clock).start())[-1]
    return {
        "device": "LDROBOT LD06, LD19 or STL-19P",
        "port": port.name,
        "turns_per_second": packet.speed / 360,
        "stamp_ms": packet.stamp,
        "ranges_m": [distance / 1000 for distance in packet.decoded()["distance"].tolist()],
    }
