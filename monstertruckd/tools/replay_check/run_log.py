"""A run that the recorder split into parts, read as the one log it is."""

from collections.abc import Iterator
from pathlib import Path
from typing import Final

from mcap.records import Attachment, McapRecord, Metadata

from monstertruck_runtime.errors import InputError
from monstertruckd.recorder.log_file import NAME
from monstertruckd.recorder.reader import LogMessage, LogReader, open_log

ALIKE: Final = ("config.json", "versions.json", "calibration.json")
"""Attachments that all parts of a run share."""

Identity = tuple[dict[str, str], dict[str, bytes]]
"""What the parts of a run have in common: its metadata, and the attachments of ``ALIKE``."""


def parts_of(log: Path) -> list[Path]:
    """All parts of the run of ``log``, in their order; ``log`` alone if its name is none of the recorder's.

    Raises:
        InputError: the run's first part is not there.
    """
    named = NAME.fullmatch(log.name)
    if named is None or not log.is_file():
        return [log]
    run = ((path, NAME.fullmatch(path.name)) for path in log.parent.iterdir())
    parts = {int(name[2]): path for path, name in run if name and name[1] == named[1]}
    if 0 not in parts:
        first = log.with_name(f"run-{named[1]}-000.mcap")
        raise InputError(f"{log}: {first.name} is not there: expected the first part of the run, which begins with 0")
    return [parts[number] for number in sorted(parts)]


class RunLog:
    """The messages of a run, once or again; ends at the first error, or before a part that is not there.

    Args:
        log: any part of it, or a log under another name.

    Raises:
        NotFoundError: no such file.
        InputError: not an MCAP file, no first part, or a part of another run.
    """

    def __init__(self, log: Path) -> None:
        self._readers = [open_log(part) for part in parts_of(log)]
        self.path = log
        self.damage: str | None = None
        """After an iteration to the end: why it ended early; None for a sound run."""
        self._before = 0
        self._reader = self._readers[0]
        first = _identity(self._reader)
        for reader in self._readers[1:]:
            if not _alike(_identity(reader), first) and reader.damage is None:
                raise InputError(f"{reader.path}: is of another run than {self._reader.path.name}")

    @property
    def parts(self) -> tuple[Path, ...]:
        """The files, in their order."""
        return tuple(reader.path for reader in self._readers)

    @property
    def position(self) -> int:
        """Bytes an iteration has read so far."""
        return self._before + self._reader.position

    def preamble(self) -> Iterator[McapRecord]:
        """The records before the first message."""
        return self._readers[0].preamble()

    def __iter__(self) -> Iterator[LogMessage]:
        """What begins a later part that stood in an earlier one, the newest of every retained topic, comes but once."""
        newest: dict[str, int] = {}
        self.damage, self._reader = None, self._readers[0]
        for number, reader in enumerate(self._readers):
            self._reader, self._before = reader, sum(done.size for done in self._readers[:number])
            if (missing := self._missing_before(number)) is not None:
                self.damage = f"{missing} is not there: the run is known up to it alone"
                return
            for entry in reader:
                if entry.sequence > newest.get(entry.topic, -1) or number == 0:
                    newest[entry.topic] = entry.sequence
                    yield entry
            if reader.damage is not None:
                where = "" if len(self._readers) == 1 else f"{reader.path.name} "
                self.damage = f"{where}{reader.damage}; `monstertruckd log recover` keeps what is sound"
                return

    def _missing_before(self, number: int) -> str | None:
        path = self._readers[number].path
        named = NAME.fullmatch(path.name)
        if named is None or int(named[2]) == number:
            return None
        return f"run-{named[1]}-{number:03d}.mcap"


def _alike(one: Identity, other: Identity) -> bool:
    """Whether two parts say the same of themselves, as far as both say it: what is damaged says nothing."""
    return one[0] == other[0] and all(one[1][name] == other[1][name] for name in one[1].keys() & other[1].keys())


def _identity(reader: LogReader) -> Identity:
    run: dict[str, str] = {}
    attached: dict[str, bytes] = {}
    for record in reader.preamble():
        if isinstance(record, Attachment) and record.name in ALIKE:
            attached[record.name] = record.data
        elif isinstance(record, Metadata) and record.name == "run":
            run = dict(record.metadata)
    return run, attached
