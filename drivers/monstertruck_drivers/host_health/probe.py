"""List the health readings that a computer offers."""

from dataclasses import asdict
from pathlib import Path
from typing import Any

from monstertruck_drivers.computer import Computer
from monstertruck_drivers.host_health.config import HostHealthConfig
from monstertruck_drivers.host_health.readings import read_host
from monstertruck_runtime.clock import Clock


async def probe(computer: Computer, clock: Clock, settings: HostHealthConfig | None = None) -> dict[str, Any]:
    """Look once.

    Returns:
        JSON-able: the fields of ``Reading``.

    Raises:
        DeviceError: /proc cannot be read.
    """
    disk = Path() if settings is None else settings.disk_path
    return asdict(await computer.machine.offload(lambda: read_host(computer.root, computer.disk(disk))))
