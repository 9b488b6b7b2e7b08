"""What a log says of itself before its messages are replayed: configuration, times, first outputs."""

import json
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

from mcap.records import Attachment, Metadata
from pydantic import ValidationError

from monstertruck_runtime.errors import ConfigError, InputError, TruckError
from monstertruck_schemas.event import Event
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.topics import EVENT
from monstertruckd.config.edit import YamlText
from monstertruckd.config.migrate import bring_up_to_date
from monstertruckd.config.truck import TruckConfig
from monstertruckd.recorder.reader import CONFIG, LogMessage, attached_config
from monstertruckd.tools.replay_check.goals import GoalRecord
from monstertruckd.tools.replay_check.run_log import RunLog

SIMULATION: Final = "sim"
"""Section of the world behind emulated devices; the robot does not know it."""


@dataclass(slots=True)
class Survey:
    """Of one log."""

    start: int
    """Log time of the first message, ns."""
    end: int
    """And of the last, ns."""
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
        InputError: it holds no messages, or none of a sensor.
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
        raise InputError(f"{log.path}: holds no messages{why}")
    if not any(name.startswith("sensor/") for name in found.counts):
        raise InputError(f"{log.path}: holds no messages of sensors, so nothing can be computed again{why}")
    found.damage = log.damage
    return found


def _note_ready(entry: LogMessage, ready: dict[str, int]) -> None:
    with suppress(TruckError):
        event = entry.decode()
        if isinstance(event, Event) and event.reason is Reason.DEVICE_READY:
            ready.setdefault(event.source, entry.log_time)


def preamble(log: RunLog) -> tuple[dict[str, bytes], dict[str, str]]:
    """Attachments by name, and what the log says of its run."""
    attachments: dict[str, bytes] = {}
    run: dict[str, str] = {}
    for record in log.preamble():
        if isinstance(record, Attachment):
            attachments[record.name] = record.data
        elif isinstance(record, Metadata) and record.name == "run":
            run = dict(record.metadata)
    return attachments, run


def recorded_config(log: Path, attachments: Mapping[str, bytes]) -> TruckConfig:
    """The configuration the log was recorded with.

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
