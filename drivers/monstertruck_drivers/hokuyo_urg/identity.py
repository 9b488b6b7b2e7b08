"""Identify the scanner on a port and take one scan."""

from dataclasses import asdict

import numpy as np

from monstertruck_drivers.hokuyo_urg.config import ScipConfig
from monstertruck_drivers.hokuyo_urg.driver import Dialect, ScipSession, Sensor, split
from monstertruck_drivers.hokuyo_urg.protocol import (
    Parameters,
    ScanBlock,
    decode_scan,
    scan_command,
    scip1_scan_command,
)
from monstertruck_drivers.link import Link
from monstertruck_runtime.clock import Clock


async def identify(link: Link, clock: Clock, settings: ScipConfig) -> dict[str, object]:
    """Perform the handshake and take one scan; the laser is off afterwards.

    Returns:
        JSON-compatible dict: ``dialect``, ``identity``, ``parameters``, ``state`` and a summary of the ``scan``.

    Raises:
        DeviceError: the same errors as from the driver's ``run``.
    """
    session = ScipSession(link, clock, settings)
    sensor = await session.handshake()
    try:
        block = await _one_scan(session, sensor)
    finally:
        await session.stop()
    return {
        "dialect": sensor.dialect.value,
        "identity": asdict(sensor.identity),
        "parameters": asdict(sensor.parameters),
        "state": None if sensor.state is None else asdict(sensor.state),
        "scan": _summary(block, sensor.parameters, settings),
    }


async def _one_scan(session: ScipSession, sensor: Sensor) -> ScanBlock:
    shape = (sensor.parameters.first_step, sensor.parameters.last_step)
    if sensor.dialect is Dialect.SCIP1:
        await session.demand("L1")
        return decode_scan(await session.demand(scip1_scan_command(*shape)), *shape)
    command = scan_command("MD", *shape, count=1)
    await session.demand(command)
    reply = await session.next_reply(1.6)  # seconds allowed for the first scan
    return decode_scan(reply, *shape)


def _summary(block: ScanBlock, parameters: Parameters, settings: ScipConfig) -> dict[str, object]:
    ranges, codes = split(block.values, parameters, settings)
    valid = ranges[np.isfinite(ranges)]
    kinds, counts = np.unique(codes[~np.isfinite(ranges)], return_counts=True)
    return {
        "counter_ms": block.counter,
        "beams": len(ranges),
        "valid": len(valid),
        "nearest_m": float(valid.min()) if len(valid) else None,
        "farthest_m": float(valid.max()) if len(valid) else None,
        "error_codes": {str(kind): int(count) for kind, count in zip(kinds, counts, strict=True)},
    }
