"""Repair of logs that a crash left without an index.

``python -m monstertruckd.recorder.repair FOLDER`` repairs the unfinished logs of a folder at low priority. The recorder
starts it as a separate process, because a thread would compete with the control loop for the interpreter.
"""

import fcntl
import json
import logging
import os
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import BinaryIO, Final

from mcap.records import Attachment, Header, Metadata
from mcap.writer import Writer

from monstertruck_runtime.errors import InputError, TruckError
from monstertruck_runtime.outside import reading
from monstertruck_runtime.small_files import damaged_names, sync_folder
from monstertruckd.recorder.frames import is_finished, open_file
from monstertruckd.recorder.log_damage import LogDamage, judged
from monstertruckd.recorder.log_file import CHANNELS
from monstertruckd.recorder.salvage import ChannelFacts, Salvage

log = logging.getLogger(__name__)

_PART: Final = ".part"
RECOVERED: Final = "recovered"
"""Metadata record of a repaired log: name of the original log, and the losses."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Recovery(LogDamage):
    """Outcome of a repair."""

    path: Path
    """Repaired file; the log itself if it was undamaged."""
    original: Path | None = None
    """Path of the kept damaged log; None if the log was undamaged or has not moved."""

    def __str__(self) -> str:
        if self.damage is None:
            return f"{self.path}: {self.messages} messages kept, the log was intact"
        text = f"{self.path}: {self.messages} messages kept, {self.losses}; it {self.damage}"
        return text if self.original is None else f"{text}; the original is {self.original}"


def in_use(path: Path) -> bool:
    """Return whether a recorder or a repair has locked the file; two simultaneous callers do not detect each other."""
    with path.open("rb") as file:
        return not _lock(file, fcntl.LOCK_SH)


def recover(source: str | Path, target: str | Path, stop: threading.Event | None = None) -> Recovery:
    """Rewrite every intact chunk of ``source`` as a finished log ``target``.

    ``target`` appears complete or not at all. It may be ``source`` itself: an undamaged log is left unchanged; a
    damaged log is kept unchanged as NAME.mcap.damaged, and the repaired log takes its name.

    Args:
        source: damaged log.
        target: repaired log.
        stop: event set by another thread to abandon the repair.

    Raises:
        InputError: not a log, being written right now, or ``target`` is another file or cannot be written.
        NotFoundError: no such file.
    """
    source, target = Path(source), Path(target)
    with open_file(source) as original:
        if not _lock(original, fcntl.LOCK_EX):
            raise InputError(f"{source}: is being written")
        in_place = target.exists()
        if in_place and not target.samefile(source):
            raise InputError(f"{target}: already exists; choose another name")
        with reading(source, "an MCAP log"):
            salvage = Salvage(original)
        if salvage.strange:
            raise InputError(f"{source}: not an MCAP log")
        with _written(target) as part:
            with part.open("wb") as output:
                done = _copy(salvage, source, output, stop)
                output.flush()
                os.fsync(output.fileno())
            if in_place and done.damage is None:
                part.unlink()
                return _recovery(done, source)
            kept = _keep(source) if in_place else None
            part.replace(target)
            sync_folder(target.parent)
    return _recovery(done, target, kept)


def _recovery(done: LogDamage, path: Path, original: Path | None = None) -> Recovery:
    return Recovery(**asdict(done), path=path, original=original)


@contextmanager
def _written(target: Path) -> Iterator[Path]:
    """Yield the path for writing ``target`` until it is complete; remove the partial file if the body fails."""
    part = target.with_name(target.name + _PART)
    try:
        yield part
    except BaseException as error:
        with suppress(OSError):
            part.unlink(missing_ok=True)
        if isinstance(error, OSError):
            raise InputError(f"{target}: cannot be written: {error.strerror}") from error
        raise


def _keep(source: Path) -> Path:
    """Give a damaged log a second name to keep it; an interrupted repair may already have done so."""
    for kept in damaged_names(source):
        if not os.path.lexists(kept):
            kept.hardlink_to(source)
            sync_folder(source.parent)
            return kept
        if kept.samefile(source):
            return kept
    raise AssertionError


def recover_directory(directory: Path, stop: threading.Event | None = None) -> list[Recovery]:
    """Repair every unfinished log in a folder in place; files in use and other files are skipped."""
    return [outcome for outcome in _repairs(directory, stop) if isinstance(outcome, Recovery)]


def _repairs(directory: Path, stop: threading.Event | None = None) -> Iterator[Recovery | TruckError | OSError]:
    """Repair every unfinished log in a folder; log and yield each outcome."""
    for path in sorted(directory.glob("*.mcap")):
        try:
            if not _unfinished(path):
                continue
            recovery = recover(path, path, stop)
        except (TruckError, OSError) as error:
            log.warning("not repaired: %s", error)
            yield error
        else:
            log.log(logging.WARNING if recovery.costs else logging.INFO, "repaired %s", recovery)
            yield recovery
        if stop is not None and stop.is_set():
            break


def _unfinished(path: Path) -> bool:
    """Return whether a log needs repair; a folder or pipe with such a name does not.

    Raises:
        OSError: the log cannot be read.
    """
    return path.is_file() and not is_finished(path) and not in_use(path)


def _lock(file: BinaryIO, how: int) -> bool:
    try:
        fcntl.flock(file, how | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True


def _copy(salvage: Salvage, source: Path, output: BinaryIO, stop: threading.Event | None) -> LogDamage:
    """Copy all intact records and record the losses in the metadata ``recovered``."""
    writer = Writer(output)
    registered = _Registered(writer)
    started = False
    for record in salvage.records():
        if stop is not None and stop.is_set():
            raise InputError(f"{source}: repair abandoned")
        if not started:
            header = record if isinstance(record, Header) else Header("", "")
            writer.start(header.profile, header.library)
            started = True
        if isinstance(record, tuple):
            message, facts = record
            channel = registered.channel(message.channel_id, facts)
            writer.add_message(channel, message.log_time, message.data, message.publish_time, message.sequence)
        elif isinstance(record, Attachment):
            writer.add_attachment(record.create_time, record.log_time, record.name, record.media_type, record.data)
        elif isinstance(record, Metadata) and record.name != CHANNELS:
            writer.add_metadata(record.name, dict(record.metadata))
    if not started:
        writer.start()
    done = judged(salvage)
    if done.damage is not None:
        notes = {"log": source.name, "damage": done.damage, "kept": done.messages, "lost": done.lost}
        writer.add_metadata(RECOVERED, {name: str(value) for name, value in notes.items()} | {"spans": done.times})
    writer.finish()  # type: ignore[no-untyped-call]
    return done


class _Registered:
    """Channels and schemas of a new file, each registered once."""

    def __init__(self, writer: Writer) -> None:
        self._writer = writer
        self._schemas: dict[tuple[str, str, bytes] | None, int] = {None: 0}
        self._channels: dict[tuple[int, ChannelFacts], int] = {}

    def channel(self, number: int, facts: ChannelFacts) -> int:
        """Return the number in the new file for a channel of the old file."""
        if (number, facts) not in self._channels:
            if facts.schema not in self._schemas and facts.schema is not None:
                self._schemas[facts.schema] = self._writer.register_schema(*facts.schema)
            schema = self._schemas[facts.schema]
            self._channels[number, facts] = self._writer.register_channel(
                facts.topic, facts.message_encoding, schema, dict(facts.metadata)
            )
        return self._channels[number, facts]


def start_repair(folder: Path) -> "subprocess.Popen[bytes] | None":
    """Start the repair process if there is anything to repair.

    Raises:
        OSError: the folder cannot be read, or no process can be started.
    """
    if not any(_may_wait(path) for path in folder.glob("*.mcap")):
        return None
    command = [sys.executable, "-m", "monstertruckd.recorder.repair", str(folder)]
    return subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE)  # noqa: S603  # our own module


def repairs(process: "subprocess.Popen[bytes]") -> Iterator[str]:
    """Yield the outcome for each log as text, until the process ends."""
    assert process.stdout is not None
    with process.stdout as lines:
        for line in lines:
            with suppress(ValueError):
                yield str(json.loads(line))


def _may_wait(path: Path) -> bool:
    """Return whether a log may need repair; the repair process reports unreadable logs."""
    try:
        return _unfinished(path)
    except OSError:
        return True


def main(folder: Path) -> None:
    """Repair ``folder``; print the outcome for each log as a JSON string per line."""
    os.nice(15)
    logging.disable()  # the daemon reports the outcomes, with the journal's priorities
    for outcome in _repairs(folder):
        text = f"repaired {outcome}" if isinstance(outcome, Recovery) else f"not repaired: {outcome}"
        sys.stdout.write(json.dumps(text) + "\n")
        sys.stdout.flush()


if __name__ == "__main__":
    main(Path(sys.argv[1]))
