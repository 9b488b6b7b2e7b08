"""Checks of a truck's computer before it drives: faults, and the commands that fix them."""

from monstertruckd.tools.doctor import computer, devices, history, software
from monstertruckd.tools.doctor.context import Finding, HostContext


async def examine(context: HostContext, *, ask_devices: bool = True) -> list[Finding]:
    """Return all findings.

    Nothing moves; only the latency of adapters is changed through which devices are queried.

    Args:
        context: computer to examine.
        ask_devices: whether to query the identity of connected devices.
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
