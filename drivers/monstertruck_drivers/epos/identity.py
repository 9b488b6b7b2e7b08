"""Read a controller without moving or changing it."""

from typing import Any

from monstertruck_drivers.epos import objects as od
from monstertruck_drivers.epos.config import EposConfig
from monstertruck_drivers.epos.exchange import ATTEMPTS, Exchanger, read_identity
from monstertruck_drivers.epos.protocol import state_of
from monstertruck_drivers.link import Link
from monstertruck_runtime.clock import Clock
from monstertruck_runtime.errors import DeviceTimeoutError, ProtocolError, WrongDeviceError


async def identify(link: Link, clock: Clock, settings: EposConfig) -> dict[str, Any]:
    """Read the identity, state, fault history and first samples; nothing is written.

    Args:
        link: open link to the controller.
        clock: time.
        settings: driver settings with the node id.

    Returns:
        JSON-compatible report in the controller's own units and sign.

    Raises:
        DeviceLostError: the link went down.
        DeviceTimeoutError, ProtocolError: no usable answers.
        WrongDeviceError: another device answers.
    """
    line = Exchanger(link, clock, settings.node)
    try:
        return await _report(line, clock)
    except (DeviceTimeoutError, ProtocolError) as error:
        if line.strange and not line.acknowledged:
            raise WrongDeviceError(f"not an EPOS, it sends {line.strange[:20]!r}: {error}") from error
        raise
    finally:
        await line.close()


async def _report(line: Exchanger, clock: Clock) -> dict[str, Any]:
    statusword = await line.read(od.STATUSWORD, ATTEMPTS)
    identity = await read_identity(line)
    count = min(await line.read(od.ERROR_COUNT, ATTEMPTS), od.HISTORY_SIZE)
    history = [await line.read(entry, ATTEMPTS) & 0xFFFF for entry in od.ERROR_HISTORY[:count]]
    samples = []
    for _ in range(5):
        samples.append(
            {
                "position_counts": await line.read(od.POSITION, ATTEMPTS),
                "velocity_rpm": await line.read(od.VELOCITY_AVERAGED, ATTEMPTS),
                "current_ma": await line.read(od.CURRENT, ATTEMPTS),
            }
        )
        await clock.sleep(0.05)
    return {
        "identity": {**identity.as_values(), "serial_number": await _serial_number(line)},
        "state": state_of(statusword).name,
        "statusword": statusword,
        "mode": await line.read(od.MODE_DISPLAY, ATTEMPTS),
        "faults": [{"code": code, "text": od.fault_text(code)} for code in history],
        "samples": samples,
    }


async def _serial_number(line: Exchanger) -> str | None:
    """Serial number (hexadecimal); None if segmented reads do not work as documented."""
    try:
        return (await line.read_long(od.SERIAL_NUMBER)).hex()
    except (DeviceTimeoutError, ProtocolError):
        return None
