"""Does the port send scans of this data sheet?"""

from monstertruck_drivers.link import Port
from monstertruck_drivers.sheet_lidar.config import SheetLidarConfig
from monstertruck_drivers.sheet_lidar.driver import EXPECTED
from monstertruck_drivers.sheet_lidar.protocol import SheetParser
from monstertruck_drivers.streaming import DeviceStream
from monstertruck_runtime.clock import Clock


async def probe(port: Port, clock: Clock, settings: SheetLidarConfig | None = None) -> dict[str, object]:
    """Listen for one scan.

    Returns:
        JSON-able: ``device``, ``port``, ``beams``, ``stamp_ms``, ``returns``.

    Raises:
        DeviceError: see the driver's ``run``.
    """
    config = settings or SheetLidarConfig()
    async with await port.open() as link:
        scan = (await DeviceStream(link, clock, SheetParser(config.beams).feed).first(config.first_scan, EXPECTED))[-1]
    return {
        "device": "laser scanner described by its data sheet",
        "port": port.name,
        "beams": len(scan.ranges),
        "stamp_ms": scan.stamp,
        "returns": int((scan.ranges > 0).sum()),
    }
