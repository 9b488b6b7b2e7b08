"""A short log of several topics, and what is in it."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from monstertruck_runtime import wire
from monstertruck_runtime.clock import SECOND
from monstertruck_schemas import topics as t
from monstertruck_schemas.health import HealthTable, ServiceHealth, ServiceState
from monstertruck_schemas.plan import Path as TruckPath
from monstertruck_schemas.sensor import Attitude, Vector3
from monstertruckd.recorder.log_file import LogEntry, LogFile
from tests.unit.recorder.conftest import scan, steering


def compass(now, seq):
    field = Vector3(x=1.0, y=2.0, z=3.0) if seq % 2 else None
    return Attitude(stamp=now, received=now, seq=seq, heading=1.0, roll=0.0, pitch=0.0, magnetic_field=field)


def health(now, seq):
    row = ServiceHealth(name="lidar", state=ServiceState.READY, since=now)
    return HealthTable(stamp=now, received=now, seq=seq, services=(row,))


def path(now, seq):
    return TruckPath(stamp=now, received=now, seq=seq, poses=np.zeros(3 * (seq + 1)), directions=[], name="lap")


MAKERS = {t.CMD_STEERING: steering, t.SCAN: scan, t.COMPASS: compass, t.HEALTH: health, t.PATH: path}


def write(file: Path, messages=40, compression="lz4") -> list[tuple]:
    """A log with a chunk every ten messages; returns what is in it."""
    log = LogFile(file, compression, 1 << 20, {"config": {"a": 1}}, {"robot": "truck"}, SECOND)
    written = []
    for i in range(messages):
        for topic, make in MAKERS.items():
            now = SECOND + i * SECOND // 10
            message = make(now, i)
            log.add(LogEntry(topic, now, now, i, wire.encode(topic, message)))
            written.append((topic.name, now, message))
        if i % 10 == 9:
            log.flush()
    log.finish()
    return written


@contextmanager
def flipped(log: Path, place: int, bit: int) -> Iterator[None]:
    """A log with one bit flipped for a while, in place: a disk under load needs long for thousands of new files."""
    with log.open("r+b", buffering=0) as file:
        byte = os.pread(file.fileno(), 1, place)[0]
        os.pwrite(file.fileno(), bytes([byte ^ bit]), place)
        try:
            yield
        finally:
            os.pwrite(file.fileno(), bytes([byte]), place)
