"""Repair of logs that a crash left without an index.

``python -m monstertruckd.recorder.repair FOLDER`` repairs a folder's unfinished logs, niced. The recorder starts
this as a process of its own: a thread would compete with the control loop for the interpreter.
"""

import fcntl
import logging
import os
import subprocess
import sys
import threading
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO, Final

from mcap.records import Attachment, Channel, Header, Message, Metadata, Schema
from mcap.writer import Writer

from monstertruck_runtime.errors import InputError, TruckError
from monstertruckd.recorder.reader import LogReader, is_finished

log = logging.getLogger(__name__)

_PART: Final = ".part"


@dataclass(frozen=True, slots=True)
class Recovery:
    """Outcome of one repair."""

    path: Path
    """The repaired file."""
    messages: int
    damage: str | None
    """What was wrong with the original; None when it was sound."""


def in_use(path: Path) -> bool:
    """Whether the file is locked by a recorder or a repair; two who ask at once do not see each other."""
    with path.open("rb") as file:
        return not _lock(file, fcntl.LOCK_SH)


def recover(source: str | Path, target: str | Path, stop: threading.Event | None = None) -> Recovery:
    """Rewrite everything up to the first error of ``source`` as a finished log ``target``.

    One streaming pass; ``target`` appears complete or not at all, and may be ``source`` itself, which is left as it is
    if it is sound.

    Args:
        source: the damaged log.
        target: the repaired one.
        stop: set by another thread, abandons the repair.

    Raises:
        InputError: not a log, being written right now, or ``target`` is another file or cannot be written.
        NotFoundError: no such file.
    """
    source, target = Path(source), Path(target)
    reader = LogReader(source)
    part = target.with_name(target.name + _PART)
    with source.open("rb") as original:
        if not _lock(original, fcntl.LOCK_EX):
            raise InputError(f"{source}: is being written")
        in_place = target.exists()
        if in_place and not target.samefile(source):
            raise InputError(f"{target}: exists already; name a new file")
        try:
            with part.open("wb") as output:
                messages = _copy(reader, output, stop)
                output.flush()
                os.fsync(output.fileno())
            if in_place and reader.fault is None:
                part.unlink()
            else:
                part.replace(target)
        except OSError as error:
            part.unlink(missing_ok=True)
            raise InputError(f"{target}: cannot be written: {error.strerror}") from error
        except BaseException:
            part.unlink(missing_ok=True)
            raise
    return Recovery(target, messages, reader.fault)


def recover_directory(directory: Path, stop: threading.Event | None = None) -> list[Recovery]:
    """Repair every unfinished log of a folder in place; files in use and other files are skipped."""
    done = []
    for path in sorted(directory.glob("*.mcap")):
        try:
            if not _unfinished(path):
                continue
            recovery = recover(path, path, stop)
        except (TruckError, OSError) as error:
            log.warning("not repaired: %s", error)
        else:
            log.info("repaired %s: %d messages", path, recovery.messages)
            done.append(recovery)
        if stop is not None and stop.is_set():
            break
    return done


def _unfinished(path: Path) -> bool:
    """Whether a log waits for repair; a folder or pipe of that name does not.

    Raises:
        OSError: it cannot be read.
    """
    return path.is_file() and not is_finished(path) and not in_use(path)


def _lock(file: BinaryIO, how: int) -> bool:
    try:
        fcntl.flock(file, how | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True


def _copy(reader: LogReader, output: BinaryIO, stop: threading.Event | None) -> int:
    """Copy all records; returns the number of messages."""
    writer = Writer(output)
    schemas = {0: 0}
    channels: dict[int, int] = {}
    messages = 0
    started = False
    for record in reader.records():
        if stop is not None and stop.is_set():
            raise InputError(f"{reader.path}: repair abandoned")
        if not started:
            header = record if isinstance(record, Header) else Header("", "")
            writer.start(header.profile, header.library)
            started = True
        if isinstance(record, Schema) and record.id not in schemas:
            schemas[record.id] = writer.register_schema(record.name, record.encoding, record.data)
        elif isinstance(record, Channel) and record.id not in channels:
            schema = schemas.get(record.schema_id, 0)
            channels[record.id] = writer.register_channel(
                record.topic, record.message_encoding, schema, dict(record.metadata)
            )
        elif isinstance(record, Message):
            writer.add_message(
                channels[record.channel_id], record.log_time, record.data, record.publish_time, record.sequence
            )
            messages += 1
        elif isinstance(record, Attachment):
            writer.add_attachment(record.create_time, record.log_time, record.name, record.media_type, record.data)
        elif isinstance(record, Metadata):
            writer.add_metadata(record.name, dict(record.metadata))
    if not started:
        writer.start()
    writer.finish()  # type: ignore[no-untyped-call]
    return messages


NICENESS = 15


def start_repair(folder: Path) -> "subprocess.Popen[bytes] | None":
    """Start the process if there is anything to repair.

    Raises:
        OSError: the folder cannot be read, or no process can be started.
    """
    if not any(_may_wait(path) for path in folder.glob("*.mcap")):
        return None
    command = [sys.executable, "-m", "monstertruckd.recorder.repair", str(folder)]
    return subprocess.Popen(command, stdin=subprocess.DEVNULL)  # noqa: S603  # our own module, no shell


def _may_wait(path: Path) -> bool:
    """Whether a log may wait for repair: of one that cannot be read the process tells."""
    try:
        return _unfinished(path)
    except OSError:
        return True


def main(folder: Path) -> None:
    """Repair ``folder``."""
    os.nice(NICENESS)
    logging.basicConfig(level=logging.INFO, format="%(levelname)-7s %(name)s: %(message)s")
    recover_directory(folder)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
