"""Find and read the units on the bus without moving them."""

from monstertruck_drivers.ax12 import protocol as p
from monstertruck_drivers.ax12.config import Ax12Config
from monstertruck_drivers.ax12.protocol import Present, alarm_names, word
from monstertruck_drivers.ax12.session import Ax12Session
from monstertruck_drivers.link import Link
from monstertruck_runtime.clock import Clock
from monstertruck_runtime.errors import DeviceTimeoutError, ProtocolError, WrongDeviceError

IDS = range(1, 7)
"""Unit numbers to ping: the numbers on the robot's bus."""


async def identify(link: Link, clock: Clock, settings: Ax12Config) -> dict[str, object]:
    """Ping units 1 to 6 at 1 Mbaud and read the settings and state of each unit that answers.

    Returns:
        JSON-compatible dict: ``echo`` (whether the adapter echoes) and ``units``, with each unit's id, model, firmware,
        limits, status level, error names, position in steps, voltage, temperature and torque settings.

    Raises:
        DeviceTimeoutError: nothing answered; the message names what to check.
        WrongDeviceError: bytes arrived, but not from an AX-12A.
    """
    session = Ax12Session(link, clock, settings.timeout)
    await session.find_echo(*IDS)
    units = [found for unit in IDS if (found := await _describe(session, unit)) is not None]
    if not units and session.strange:
        raise WrongDeviceError(f"{link.name}: {session.strange} bytes, but no answer of an AX-12A")
    if not units:
        raise DeviceTimeoutError(
            f"{link.name}: silent; expected AX-12A units: check the 12 V rail, and that the adapter is set to TTL"
        )
    return {"echo": session.echo, "units": units}


async def _describe(session: Ax12Session, unit: int) -> dict[str, object] | None:
    try:
        error = await session.ping(unit)
    except DeviceTimeoutError:
        return None
    known: dict[str, object] = {"id": unit, "errors": alarm_names(error)}
    try:
        stored = (await session.read(unit, p.MODEL_NUMBER, 19)).data
        settings = (await session.read(unit, p.TORQUE_ENABLE, 12)).data
        present = Present.decode((await session.read(unit, p.PRESENT_POSITION, p.PRESENT_SIZE)).data)
    except (DeviceTimeoutError, ProtocolError) as failure:
        return known | {"unreadable": str(failure)}
    return known | {
        "model": word(stored),
        "firmware": stored[p.FIRMWARE.address],
        "limits": [word(stored, p.CW_LIMIT.address), word(stored, p.CCW_LIMIT.address)],
        "status_level": stored[p.STATUS_LEVEL.address],
        "torque_enabled": bool(settings[0]),
        "torque_limit": word(settings, 10),
        "position": present.position,
        "voltage": round(present.voltage * p.VOLT_UNIT, 1),
        "temperature": present.temperature,
    }
