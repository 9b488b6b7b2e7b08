"""Recordings: data written before the death of the recorder survives the repair at the next start."""

import random
from collections.abc import Iterator
from pathlib import Path
from typing import Final

from mcap.reader import make_reader

from benchmarks.durability_parts.subject import Death, Subject
from monstertruck_runtime.clock import SECOND
from monstertruck_schemas.topics import CMD_STEERING
from monstertruckd.recorder.config import Compression, RecorderConfig
from monstertruckd.recorder.log_file import LogEntry
from monstertruckd.recorder.recorder import LogWriter
from monstertruckd.recorder.repair import recover_directory

PERIOD: Final = SECOND // 50
"""Time between two messages, ns."""
GROUP: Final = 10
"""Messages a line."""
CHUNK: Final = 0.5
SYNC: Final = 2.0
"""Settings ``chunk_seconds`` and ``fsync_seconds`` of these runs."""
KEPT_AFTER: Final = {Death.KILL: 1.5 * CHUNK, Death.CUT: 1.5 * CHUNK + SYNC}
"""Seconds after which a message is kept, as docs/logs.md says."""


def payload(number: int) -> bytes:
    """Return the content of a message, partly incompressible."""
    return b'{"number": %d, "noise": "%s"}' % (number, random.Random(number).randbytes(number % 300).hex().encode())


def write(folder: Path, seed: int) -> Iterator[str]:
    """Record; yield the number of messages passed to the writer."""
    rng = random.Random(seed)
    config = RecorderConfig(
        directory=str(folder / "logs"),
        chunk_seconds=CHUNK,
        fsync_seconds=SYNC,
        chunk_size=rng.choice((4096, 256 * 1024)),
        rotate_seconds=rng.choice((5.0, 1800.0)),
        compression=rng.choice(tuple(Compression)),
    )
    with LogWriter(config, {"config": {"robot": "truck"}}, {"robot": "truck"}, 0) as writer:
        number = 0
        while True:
            for _ in range(GROUP):
                at = number * PERIOD
                writer.write(LogEntry(CMD_STEERING, at, at, number, payload(number)))
                number += 1
            yield str(number)


def check(folder: Path, acknowledged: list[str], death: Death) -> str | None:
    """Repair as at the next start, and look for every message that is old enough."""
    logs = folder / "logs"
    if not logs.is_dir():
        return "no folder of logs" if acknowledged else None
    recover_directory(logs)
    found: list[int] = []
    for path in sorted(logs.glob("*.mcap")):
        with path.open("rb") as file:
            for _, _, message in make_reader(file, validate_crcs=True).iter_messages():
                if message.data != payload(message.sequence):
                    return f"message {message.sequence} of {path.name} holds something else"
                found.append(message.sequence)
    if len(found) != len(set(found)):
        return "a message is there twice"
    given = int(acknowledged[-1]) if acknowledged else 0
    kept = given - round(KEPT_AFTER[death] * SECOND / PERIOD)
    lost = set(range(kept)) - set(found)
    return f"{len(lost)} of {kept} messages are lost" if lost else None


SUBJECT: Final = Subject("recordings", write, check, changes=60)
