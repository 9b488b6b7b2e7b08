"""Who is on the port, and what do its counters say?"""

from monstertruck_drivers.link import Port
from monstertruck_drivers.roboclaw.config import RoboclawConfig
from monstertruck_drivers.roboclaw.session import RoboclawSession
from monstertruck_runtime.clock import Clock


async def probe(port: Port, clock: Clock, settings: RoboclawConfig | None = None) -> dict[str, object]:
    """Identity and one reading.

    Returns:
        JSON-able: ``device``, ``port``, ``version``, ``counts`` of inputs 1 and 2.

    Raises:
        DeviceError: see the driver's ``run``.
    """
    settings = settings or RoboclawConfig()
    async with await port.open() as link:
        session = RoboclawSession(link, clock, settings.address, settings.answer_timeout)
        return {
            "device": "RoboClaw with encoders",
            "port": port.name,
            "version": await session.identify(),
            "counts": list(await session.counts()),
        }
