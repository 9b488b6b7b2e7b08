"""A recorded run: its parts read as one log, and its configuration, times and first outputs."""

import json
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

from pydantic import ValidationError

from monstertruck_runtime.errors import ConfigError, InputError, TruckError
from monstertruck_schemas.event import Event
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.topics import EVENT
from monstertruckd.config.load import YamlText, bring_up_to_date
from monstertruckd.config.truck import TruckConfig
from monstertruckd.recorder.log_file import NAME, RUN_LOG
from monstertruckd.recorder.reader import CONFIG, LogMessage, LogReader, attached_config, open_log
from monstertruckd.tools.replay_check.goals import GoalRecord

ALIKE: Final = ("config.json", "versions.json", "calibration.json")
"""Attachments that all parts of a run share."""

Identity = tuple[dict[str, str], dict[str, bytes]]
"""Common data of a run's parts: metadata, and the attachments of ``ALIKE``."""


def parts_of(log: Path) -> list[Path]:
    """Return all parts of the run of ``log``, in order; only ``log`` if the recorder did not name it.

    Raises:
        InputError: the run's first part is missing.
    """
    named = NAME.fullmatch(log.name)
    if named is None or not log.is_file():
        return [log]
    run = ((path, NAME.fullmatch(path.name)) for path in log.parent.iterdir())
    parts = {int(name[2]): path for path, name in run if name and name[1] == named[1]}
    if 0 not in parts:
        first = log.with_name(f"run-{named[1]}-000.mcap")
        raise InputError(f"{log}: {first.name} is missing: expected the first part of the run, which starts with 0")
    return [parts[number] for number in sorted(parts)]


def run_of(log: Path) -> tuple[Path, int | None]:
    """Return the log to recompute for ``log``, so that filters begin with its run, and its end in daemon time, ns.

    Returns:
        The log itself, to its end; for a black box a log of its run, up to the end of the box.

    Raises:
        NotFoundError: no such log.
        InputError: not a log, or the run's log of a black box is missing.
    """
    reader = open_log(log)
    named = reader.metadata().get("run", {}).get(RUN_LOG)
    if named is None:
        return log, None
    places = (Path(named), *(folder / Path(named).name for folder in log.absolute().parents[:2]))
    found = next((place for place in places if place.is_file()), None)
    if found is None:
        raise InputError(f"{log}: starts in the middle of its run, and the run's log {named} is missing")
    return found, max((message.log_time for message in reader), default=0)


class RunLog:
    """The messages of a run, readable repeatedly; ends at the first error, or before a missing part.

    Args:
        log: any part of it, or a log under another name.
        until: daemon time of the end, ns; None for the whole log.

    Raises:
        NotFoundError: no such file.
        InputError: not an MCAP file, no first part, or a part of another run.
    """

    def __init__(self, log: Path, until: int | None = None) -> None:
        self._until = until
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
        """The files, in order."""
        return tuple(reader.path for reader in self._readers)

    @property
    def position(self) -> int:
        """Bytes read so far by an iteration."""
        return self._before + self._reader.position

    @property
    def first(self) -> LogReader:
        """Return the first part, whose attachments belong to the run."""
        return self._readers[0]

    def __iter__(self) -> Iterator[LogMessage]:
        """Skip the retained messages at the start of a later part that an earlier part contains."""
        newest: dict[str, int] = {}
        self.damage, self._reader = None, self._readers[0]
        for number, reader in enumerate(self._readers):
            self._reader, self._before = reader, sum(done.size for done in self._readers[:number])
            if (missing := self._missing_before(number)) is not None:
                self.damage = f"{missing} is missing: the run is known only up to it"
                return
            for entry in reader.before_damage():
                if self._until is not None and entry.log_time > self._until:
                    return
                if entry.sequence > newest.get(entry.topic, -1) or number == 0:
                    newest[entry.topic] = entry.sequence
                    yield entry
            if reader.damage is not None:
                where = "" if len(self._readers) == 1 else f"{reader.path.name} "
                self.damage = f"{where}{reader.damage}; `monstertruckd log recover` keeps the intact part"
                return

    def _missing_before(self, number: int) -> str | None:
        path = self._readers[number].path
        named = NAME.fullmatch(path.name)
        if named is None or int(named[2]) == number:
            return None
        return f"run-{named[1]}-{number:03d}.mcap"


def _alike(one: Identity, other: Identity) -> bool:
    """Return whether two parts agree in their common data; damaged data is ignored."""
    return one[0] == other[0] and all(one[1][name] == other[1][name] for name in one[1].keys() & other[1].keys())


def _identity(reader: LogReader) -> Identity:
    attached = reader.attachments()
    return reader.metadata().get("run", {}), {name: attached[name] for name in ALIKE if name in attached}


SIMULATION: Final = "sim"
"""Section of the world behind emulated devices; the robot does not know it."""


@dataclass(slots=True)
class Survey:
    """Summary of one log."""

    start: int
    """Log time of the first message, ns."""
    end: int
    """Time of the last one, ns."""
    first: dict[str, LogMessage] = field(default_factory=dict)
    """First message of every topic."""
    newest: dict[str, LogMessage] = field(default_factory=dict)
    """Last message of every topic."""
    counts: dict[str, int] = field(default_factory=dict)
    ready: dict[str, int] = field(default_factory=dict)
    """When each service was first ready, log time, ns."""
    goals: GoalRecord = field(default_factory=GoalRecord)
    damage: str | None = None

    def lost(self) -> dict[str, int]:
        """Messages that never reached the log, by topic: gaps in the recorder's count."""
        spans = {name: self.newest[name].sequence - first.sequence + 1 for name, first in self.first.items()}
        return {name: gap for name, span in spans.items() if (gap := span - self.counts[name]) > 0}


def survey(log: RunLog) -> Survey:
    """Read the log once.

    Raises:
        InputError: it contains no messages, or none of a sensor.
    """
    found: Survey | None = None
    for entry in log:
        if found is None:
            found = Survey(entry.log_time, entry.log_time)
        found.end = max(found.end, entry.log_time)
        found.first.setdefault(entry.topic, entry)
        found.newest[entry.topic] = entry
        found.counts[entry.topic] = found.counts.get(entry.topic, 0) + 1
        if entry.topic == EVENT.name:
            _note_ready(entry, found.ready)
        found.goals.note(entry)
    why = f" ({log.damage})" if log.damage else ""
    if found is None:
        raise InputError(f"{log.path}: contains no messages{why}")
    if not any(name.startswith("sensor/") for name in found.counts):
        raise InputError(f"{log.path}: contains no sensor messages to recompute from{why}")
    found.damage = log.damage
    return found


def _note_ready(entry: LogMessage, ready: dict[str, int]) -> None:
    with suppress(TruckError):
        event = entry.decode()
        if isinstance(event, Event) and event.reason is Reason.DEVICE_READY:
            ready.setdefault(event.source, entry.log_time)


def recorded_config(log: Path, attachments: Mapping[str, bytes]) -> TruckConfig:
    """Return the configuration of the recorded run.

    Raises:
        InputError: it is not attached, or damaged.
        ConfigError: this version refuses it.
    """
    values = attached_config(log, attachments)
    if values is None:
        raise InputError(f"{log}: {CONFIG} is not attached: expected a log that the daemon recorded")
    values.pop(SIMULATION, None)
    text = YamlText(json.dumps(values, ensure_ascii=False), log / CONFIG)  # every JSON text is one of YAML 1.2
    bring_up_to_date(text, None)
    try:
        return TruckConfig.model_validate_json(text.text)
    except ValidationError as error:
        faults = error.errors(include_url=False)
        lines = (f"{log}: {CONFIG}: {'.'.join(map(str, fault['loc']))}: {fault['msg']}" for fault in faults)
        raise ConfigError("\n".join(lines)) from None
