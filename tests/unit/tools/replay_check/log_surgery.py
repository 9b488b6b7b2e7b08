"""Logs written anew with other messages, whose checksums are right again."""

import json
from collections.abc import Callable, Iterable
from dataclasses import replace
from functools import partial
from pathlib import Path

from mcap.opcode import Opcode
from mcap.records import Attachment

from monstertruck_schemas.topics import BY_NAME
from monstertruckd.recorder.log_file import LogEntry, LogFile
from monstertruckd.recorder.reader import MAGIC, LogMessage, open_log
from monstertruckd.tools.replay_check import check_log
from monstertruckd.tools.replay_check.result import ROUND_OFF

REPLAY = Path(__file__).resolve().parents[3] / "data" / "replay"
LEVEL, SLAM, FUSION, GOALS = (REPLAY / f"{name}.mcap" for name in ("level", "slam", "fusion", "goals"))

computed_again = partial(check_log, tolerance=ROUND_OFF)
"""The stored logs were recorded on a processor whose maths routines may round otherwise than this one's."""

Change = Callable[[LogMessage], LogMessage | None]


def attachments_of(log: Path) -> dict:
    records = open_log(log).preamble()
    return {record.name: json.loads(record.data) for record in records if isinstance(record, Attachment)}


def write(target: Path, messages: Iterable[LogMessage], attachments: dict, **metadata: str) -> Path:
    """A log of these messages, numbered as they are."""
    named = {name.removesuffix(".json"): value for name, value in attachments.items()}
    file = LogFile(target, "zstd", 1 << 16, named, {"real_offset_ns": "0"} | metadata, 0)
    for one in messages:
        file.add(LogEntry(BY_NAME[one.topic], one.log_time, one.stamp, one.sequence, one.payload))
    file.finish()
    return target


def changed(log: Path, target: Path, change: Change = lambda one: one, **attachments: dict) -> Path:
    """``log`` with every message as ``change`` gives it back; None leaves it out."""
    messages = [after for one in open_log(log) if (after := change(one)) is not None]
    return write(target, messages, attachments_of(log) | attachments)


def flip(topic: str, number: int, at: Callable[[bytes], int], bit: int = 1) -> Change:
    """One bit of the ``number``-th message of ``topic``, in the byte ``at`` says."""

    def change(one: LogMessage) -> LogMessage:
        if (one.topic, one.sequence) != (topic, number):
            return one
        payload = bytearray(one.payload)
        payload[at(one.payload)] ^= bit
        return replace(one, payload=bytes(payload))

    return change


def digit(key: str, place: int = 2) -> Callable[[bytes], int]:
    """The ``place``-th decimal of a number in JSON."""

    def find(payload: bytes) -> int:
        begin = payload.index(b'"%s":' % key.encode())
        return payload.index(b".", begin) + place

    return find


def chunks(data: bytes) -> list[range]:
    """Where the chunks of an MCAP file lie; every record is an operation code, a length of 8 bytes, its content."""
    found, at = [], len(MAGIC)
    while at < len(data) - len(MAGIC):
        length = int.from_bytes(data[at + 1 : at + 9], "little")
        if data[at] == Opcode.CHUNK:
            found.append(range(at + 9, at + 9 + length))
        at += 9 + length
    return found
