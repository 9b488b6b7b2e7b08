"""Checks of a truck's computer before it drives: faults, and the commands that fix them."""

from monstertruckd.tools.doctor import computer, devices, history, software
from monstertruckd.tools.doctor.context import Finding, HostContext


async def examine(context: HostContext, *, ask_devices: bool = True) -> list[Finding]:
    """All findings.

    Nothing moves; nothing is changed but the latency of adapters through which devices are asked.

    Args:
        context: the computer.
        ask_devices: whether devices that are plugged in are asked who they are.
    """
    return [
        *software.python(context),
        *software.packages(context),
        *software.configuration(context),
        *software.motion(context),
        *software.contact(context),
        *software.sensors(context),
        *[finding async for finding in software.service(context)],
        *software.rules(context),
        *software.rights(context),
        *devices.wiring(context),
        *([finding async for finding in devices.handshakes(context)] if ask_devices else []),
        *computer.calendar(context),
        *computer.condition(context),
        *computer.link(context),
        *computer.wireless(context),
        *computer.access(context),
        *computer.card(context),
        *history.calibration(context),
        *history.newest_log(context),
    ]
