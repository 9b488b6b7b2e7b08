"""All checks of the doctor, in the order in which problems are fixed."""

from monstertruckd.tools.doctor import computer, devices, software
from monstertruckd.tools.doctor.context import Finding, HostContext


async def run_checks(context: HostContext) -> list[Finding]:
    """All findings. Nothing moves; nothing is changed but the latency of adapters through which devices are asked."""
    return [
        *software.python(context),
        *software.packages(context),
        *software.configuration(context),
        *[finding async for finding in software.service(context)],
        *software.rules(context),
        *software.rights(context),
        *devices.wiring(context),
        *[finding async for finding in devices.handshakes(context)],
        *computer.calendar(context),
        *computer.condition(context),
        *computer.link(context),
        *[finding async for finding in computer.access(context)],
    ]
