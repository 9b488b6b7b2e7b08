"""Is a USB-ISS on the port, and which sonars answer behind it?"""

from monstertruck_drivers.link import Port
from monstertruck_drivers.srf08.config import Srf08Config
from monstertruck_drivers.srf08.protocol import ADDRESSES
from monstertruck_drivers.srf08.session import Srf08Session
from monstertruck_runtime.clock import Clock


async def probe(port: Port, clock: Clock, settings: Srf08Config | None = None) -> dict[str, object]:
    """Ask for the version, and every address for its software revision.

    Returns:
        JSON-able: ``device``, ``port``, ``firmware`` of the USB-ISS, ``sonars`` (address to software revision).

    Raises:
        DeviceError: see the driver's ``run``.
    """
    async with await port.open() as link:
        session = Srf08Session(link, (settings or Srf08Config()).timeout)
        firmware = await session.start()
        readings = {address: await session.read(address) for address in ADDRESSES}
    return {
        "device": "USB-ISS with SRF08",
        "port": port.name,
        "firmware": firmware,
        "sonars": {str(address): reading.revision for address, reading in readings.items() if reading.present},
    }
