"""Is a WT61 on the port?"""

from monstertruck_drivers.link import Port
from monstertruck_drivers.wt61.config import Wt61Config
from monstertruck_drivers.wt61.driver import Wt61Session
from monstertruck_runtime.clock import Clock


async def probe(port: Port, clock: Clock, settings: Wt61Config | None = None) -> dict[str, object]:
    """Listen for one measurement.

    Returns:
        JSON-able: ``device``, ``port``, ``angular_velocity`` (rad/s), ``acceleration`` (m/s^2), ``temperature_c``.

    Raises:
        DeviceError: see the driver's ``run``.
    """
    async with await port.open() as link:
        force, rate = (await Wt61Session(link, clock).start())[-1]
    return {
        "device": "WitMotion WT61",
        "port": port.name,
        "angular_velocity": rate.angular_velocity,
        "acceleration": force.acceleration,
        "temperature_c": force.celsius,
    }
