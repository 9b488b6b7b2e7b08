"""What does the computer tell of itself."""

from dataclasses import asdict
from pathlib import Path
from typing import Any

from monstertruck_drivers.host_health.readings import disk_of, read_host
from monstertruck_runtime.threads import Offload, in_thread


async def probe(root: Path = Path("/"), disk_path: Path = Path(), offload: Offload = in_thread) -> dict[str, Any]:
    """Look once.

    Returns:
        JSON-able: the fields of ``Reading``.

    Raises:
        DeviceError: /proc cannot be read.
    """
    return asdict(await offload(lambda: read_host(root, disk_of(disk_path))))
