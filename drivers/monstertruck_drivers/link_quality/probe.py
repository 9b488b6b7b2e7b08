"""Which interfaces are there."""

from dataclasses import asdict
from pathlib import Path
from typing import Any

from monstertruck_drivers.link_quality.interfaces import choose, read_interfaces
from monstertruck_runtime.threads import Offload, in_thread


async def probe(root: Path = Path("/"), offload: Offload = in_thread) -> dict[str, Any]:
    """Look once.

    Returns:
        JSON-able: ``interfaces``, and ``chosen``: the one that is watched if none is configured.
    """
    samples = await offload(lambda: read_interfaces(root))
    chosen = choose(samples, None)
    return {"interfaces": [asdict(sample) for sample in samples], "chosen": chosen.name if chosen else None}
