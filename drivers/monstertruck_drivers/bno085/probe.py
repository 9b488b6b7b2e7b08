"""Is a BNO085 in UART-RVC mode on the port?"""

from math import degrees

from monstertruck_drivers.bno085.config import Bno085Config
from monstertruck_drivers.bno085.driver import first_frames
from monstertruck_drivers.bno085.protocol import RvcParser
from monstertruck_drivers.link import Port
from monstertruck_drivers.streaming import DeviceStream
from monstertruck_runtime.clock import Clock


async def probe(port: Port, clock: Clock, settings: Bno085Config | None = None) -> dict[str, object]:
    """Listen for one frame.

    Returns:
        JSON-able: ``device``, ``port``, ``yaw_deg`` since power-up, ``pitch_deg``, ``roll_deg``, ``acceleration``
        (m/s^2).

    Raises:
        DeviceError: see the driver's ``run``.
    """
    async with await port.open() as link:
        frame = (await first_frames(DeviceStream(link, clock, RvcParser().feed)))[-1]
    yaw, pitch, roll = (round(degrees(angle), 2) for angle in frame.angles)
    return {
        "device": "CEVA BNO085 (UART-RVC)",
        "port": port.name,
        "yaw_deg": yaw,
        "pitch_deg": pitch,
        "roll_deg": roll,
        "acceleration": frame.acceleration,
    }
