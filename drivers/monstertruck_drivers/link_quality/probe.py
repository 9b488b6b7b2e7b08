"""Which interfaces are there."""

from dataclasses import asdict
from typing import Any

from monstertruck_drivers.computer import Computer
from monstertruck_drivers.link_quality.config import LinkQualityConfig
from monstertruck_drivers.link_quality.interfaces import choose, read_interfaces
from monstertruck_runtime.clock import Clock


async def probe(computer: Computer, clock: Clock, settings: LinkQualityConfig | None = None) -> dict[str, Any]:
    """Look once.

    Returns:
        JSON-able: ``interfaces``, and ``chosen``: the one that is watched if none is configured.
    """
    samples = await computer.machine.offload(lambda: read_interfaces(computer.root))
    chosen = choose(samples, None)
    return {"interfaces": [asdict(sample) for sample in samples], "chosen": chosen.name if chosen else None}
