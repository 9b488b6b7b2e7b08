"""All checks in the order in which one mends: software, service, rights, cables, devices, computer, network."""

from monstertruckd.tools.doctor import access, handshakes, host, service, software, wiring
from monstertruckd.tools.doctor.finding import Finding
from monstertruckd.tools.doctor.patient import Patient


async def examine(patient: Patient) -> list[Finding]:
    """Look the patient over. Moves nothing and changes nothing but the latency of the adapters it asks through."""
    findings = [
        *software.python(patient),
        *software.packages(patient),
        *software.configuration(patient),
        *[finding async for finding in service.service(patient)],
        *service.rules(patient),
        *service.rights(patient),
        *wiring.wiring(patient),
        *[finding async for finding in handshakes.handshakes(patient)],
        *host.calendar(patient),
        *host.condition(patient),
        *host.link(patient),
    ]
    return [*findings, *[finding async for finding in access.access(patient)]]
