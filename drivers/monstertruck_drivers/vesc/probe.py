"""Who is on the port, and what do the motors do: without moving or changing anything."""

from monstertruck_drivers.link import Port
from monstertruck_drivers.vesc.config import VescConfig
from monstertruck_drivers.vesc.protocol import fault_text
from monstertruck_drivers.vesc.session import ATTEMPTS, VescSession
from monstertruck_runtime.clock import Clock


async def probe(port: Port, clock: Clock, settings: VescConfig | None = None) -> dict[str, object]:
    """Identity and values of every configured controller.

    Returns:
        JSON-able: ``device``, ``port``, and for each of ``motors`` its ``can_id``, ``hardware``, ``firmware``,
        ``serial``, ``erpm``, ``tachometer``, ``volts``, ``fault``.

    Raises:
        DeviceError: see the driver's ``run``.
    """
    settings = settings or VescConfig()
    async with await port.open() as link:
        session = VescSession(link, clock, settings.answer_timeout)
        found = []
        for motor in settings.motors:
            identity = await session.identify(motor.can_id)
            values = await session.values(motor.can_id, ATTEMPTS)
            found.append(
                {
                    "can_id": values.controller_id,
                    "hardware": identity.hardware,
                    "firmware": f"{identity.major}.{identity.minor:02}",
                    "serial": identity.serial.hex(),
                    "erpm": values.erpm,
                    "tachometer": values.tachometer,
                    "volts": values.volts,
                    "fault": fault_text(values.fault),
                }
            )
    return {"device": "VESC", "port": port.name, "motors": found}
