"""Damaged logs: every message in an intact chunk survives ``recover``, and the original file is unchanged."""

import random
import shutil
import sys
from collections.abc import Iterator
from io import BytesIO
from pathlib import Path
from typing import Any, Final, NamedTuple

from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.records import Channel, Chunk, Message

from monstertruck_runtime.clock import SECOND
from monstertruck_runtime.errors import InputError
from monstertruck_schemas.topics import CMD_STEERING, COMPASS
from monstertruckd.recorder.chunks import records_in, unpacked
from monstertruckd.recorder.config import Compression
from monstertruckd.recorder.frames import MAGIC
from monstertruckd.recorder.log_file import LogEntry, LogFile
from monstertruckd.recorder.repair import recover

CHUNKS: Final = 8
PER_CHUNK: Final = 10
"""Messages of each of two topics in a chunk."""
SHOWN: Final = 5
Row = tuple[str, int, bytes]
"""Topic, log time and data of a message."""


class Made(NamedTuple):
    """A log and its content."""

    data: bytes
    chunks: list[tuple[bytes, list[Row]]]
    """Each chunk's record, and its messages."""


def frames(data: bytes) -> Iterator[tuple[int, int, int]]:
    """Yield opcode, start and end of every record of an intact log."""
    at = len(MAGIC)
    while at + 9 <= len(data):
        length = int.from_bytes(data[at + 1 : at + 9], "little")
        yield data[at], at, at + 9 + length
        at += 9 + length


def made(folder: Path, compression: Compression, *, finished: bool) -> Made:
    """Write a log of eight chunks."""
    file = folder / f"{compression}-{finished}.mcap"
    log = LogFile(file, compression, 1 << 20, {"config": {"a": 1}}, {"robot": "truck"}, SECOND)
    rng = random.Random(1)
    for i in range(CHUNKS * PER_CHUNK):
        now = SECOND + i * SECOND // 10
        for topic in (CMD_STEERING, COMPASS):
            payload = b'{"n": %d, "noise": "%s"}' % (i, rng.randbytes(rng.randrange(80)).hex().encode())
            log.add(LogEntry(topic, now, now, i, payload))
        if i % PER_CHUNK == PER_CHUNK - 1:
            log.flush()
            if i // PER_CHUNK % 3 == 1:
                log.sync()
    if finished:
        log.finish()
    else:
        log.abandon()
    data, topics, chunks = file.read_bytes(), dict[int, str](), list[tuple[bytes, list[Row]]]()
    for opcode, begin, end in frames(data):
        if opcode == Opcode.CHUNK:
            rows = []
            for record in records_in(unpacked(Chunk.read(ReadDataStream(BytesIO(data[begin + 9 : end]))))):
                if isinstance(record, Channel):
                    topics[record.id] = record.topic
                elif isinstance(record, Message):
                    rows.append((topics[record.channel_id], record.log_time, record.data))
            chunks.append((data[begin:end], rows))
    return Made(data, chunks)


def read(file: Path) -> list[Row]:
    """Read all messages with the official reader."""
    with file.open("rb") as stream:
        found = make_reader(stream, validate_crcs=True).iter_messages(log_time_order=False)
        return [(channel.topic, message.log_time, message.data) for _, channel, message in found]


def damaged(data: bytes, rng: random.Random) -> bytes:
    """Return the data with one to three faults: holes, flips, cuts, repeated, overwritten or missing blocks, noise."""
    for _ in range(rng.randint(1, 3)):
        begin, end = sorted((rng.randint(0, len(data)), rng.randint(0, len(data))))
        if rng.random() < 0.5:
            end = min(end, begin + rng.randint(1, 2000))
        block, at = data[begin:end], rng.randint(0, len(data))
        match rng.choice(("hole", "flip", "flip", "cut", "twice", "over", "noise", "gone")):
            case "hole":
                data = data[:begin] + bytes(len(block)) + data[end:]
            case "flip" if block:
                data = data[:begin] + bytes([block[0] ^ 1 << rng.randrange(8)]) + data[begin + 1 :]
            case "cut":
                data = data[:end]
            case "twice":
                data = data[:at] + block + data[at:]
            case "over":
                data = data[:at] + block + data[at + len(block) :]
            case "noise":
                data = data[:begin] + rng.randbytes(len(block)) + data[end:]
            case "gone":
                data = data[:begin] + data[end:]
    return data


def wrong(log: Made, broken: bytes, file: Path, fixed: Path) -> str | None:
    """Return a fault in the repair of ``file``, which contains ``broken``, to ``fixed``; None if it is right."""
    whole = [row for chunk, rows in log.chunks if chunk in broken for row in rows]
    try:
        done = recover(file, fixed)
    except InputError as error:
        return str(error) if whole else None
    if file.read_bytes() != broken:
        return "the original is another one"
    found = read(fixed)
    if done.messages != len(found):
        return f"{done.messages} messages said to be kept, {len(found)} are"
    named = {(at, data): topic for topic, at, data in found}
    for topic, at, data in whole:
        got = named.get((at, data))
        if got is None:
            return f"a message of {topic} at {at} ns is lost, its chunk is whole"
        if done.counted and got != topic:
            return f"a message of {topic} became one of {got}"
    everything = {(at, data) for _, rows in log.chunks for _, at, data in rows}
    known = any(chunk in broken for chunk, _ in log.chunks)
    if known and not (named.keys() <= everything and len(named) == len(found)):
        return "a message is there twice, or was never recorded"
    if done.damage is None and len(named) < len(everything):
        return "messages are lost, and nothing is said"
    return None


def run(count: int, seed: int, work: Path) -> dict[str, Any]:
    """Damage and repair ``count`` logs; return the figures."""
    work.mkdir(parents=True)
    logs = [made(work, kind, finished=done) for kind in Compression for done in (True, False)]
    rng, faults, kept, lost = random.Random(seed), 0, 0, 0
    file, fixed = work / "broken.mcap", work / "fixed.mcap"
    for number in range(count):
        log = rng.choice(logs)
        broken = damaged(log.data, rng)
        fixed.unlink(missing_ok=True)
        file.write_bytes(broken)
        fault = wrong(log, broken, file, fixed)
        present = sum(chunk in broken for chunk, _ in log.chunks)
        kept, lost = kept + present, lost + CHUNKS - present
        if fault is not None:
            faults += 1
            if faults <= SHOWN:
                print(f"log {number}: {fault}", file=sys.stderr)
    shutil.rmtree(work)
    return {"logs": count, "whole_chunks": kept, "damaged_chunks": lost, "faults": faults}
