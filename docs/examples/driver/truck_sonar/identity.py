"""Identification of a range finder on a port."""

from monstertruck_drivers.link import Link
from monstertruck_runtime.clock import Clock
from truck_sonar.config import Mb7360Config
from truck_sonar.driver import readings
from truck_sonar.protocol import Parser


async def identify(link: Link, clock: Clock, settings: Mb7360Config) -> dict[str, object]:
    """Wait for one reading.

    Returns:
        JSON-able: ``distance_mm``.

    Raises:
        DeviceError: See the driver's ``run``.
    """
    return {"distance_mm": (await readings(link, Parser(), settings.timeout, clock))[-1]}
