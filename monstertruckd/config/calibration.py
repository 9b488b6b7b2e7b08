"""Calibration of a truck: measured values with their uncertainty, the folder of their files, and how they are applied.

Files are numbered and dated, ``0003-2026-11-21T160102Z.json``; the latest is used. A file is written under another
name, synced and then renamed, so after any crash the latest file is complete. No file is ever changed or removed: undo
writes a newer file with the older value.
"""

import fcntl
import os
import re
import threading
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any, Final, Literal, TypeVar

import numpy as np
from pydantic import AfterValidator, Field, ValidationError

from monstertruck_runtime.clock import SECOND
from monstertruck_runtime.errors import ConfigError, NotFoundError, UnusableFileError
from monstertruck_runtime.outside import cause_of
from monstertruck_runtime.small_files import make_folder, replace_file, require_file
from monstertruck_schemas.base import Schema, first_mistake
from monstertruckd.config.renamed import fits, present_key
from monstertruckd.config.truck import TruckConfig
from monstertruckd.config.wizards import WIZARDS

C = TypeVar("C", bound=TruckConfig)

CONFIDENCE: Final = 0.95
"""Confidence level of every interval: the share of trucks measured in this way whose true value is inside."""


Value = bool | int | float
Grade = Literal["A", "B", "C"]


def _known(name: str) -> str:
    """Return the name of a wizard.

    Raises:
        ValueError: no wizard has this name.
    """
    if name not in WIZARDS:
        raise ValueError(f"expected one of {', '.join(WIZARDS)}")
    return name


WizardName = Annotated[str, AfterValidator(_known)]


def _date(text: str) -> str:
    """Accept a date in the format of ``utc``, or an empty text.

    Raises:
        ValueError: the text has another format.
    """
    if text:
        np.datetime64(text.removesuffix("Z"), "s")
    return text


Date = Annotated[str, Field(pattern=r"^(\d{4}-.*)?$"), AfterValidator(_date)]


class Estimate(Schema):
    """One measured value."""

    name: str
    value: Value
    unit: str = ""
    low: float | None = None
    """Lower end of the interval; None: the value is a choice (a sign), not a number"""
    high: float | None = None
    samples: Annotated[int, Field(ge=1)]
    """Number of measurements"""
    meaning: str
    """Meaning of the value, and coverage of its interval"""
    key: Annotated[str, AfterValidator(present_key)] | None = None
    """Key of the configuration that the value sets, of any version; None: for information only"""
    date: str = ""
    """Time of measurement, UTC by the robot's clock; set when it is saved"""
    grade: Grade | None = None
    """Grade by the width of its interval; None without an interval or a goal"""
    valid_until: "ValidUntil | None" = None
    """Set when it is saved; None: of an older release"""
    file: Annotated[int, Field(ge=0)] = 0
    """Number of the first file that contains it, because clocks may be wrong; 0: not saved yet, or by an older
    release
    """


class ValidUntil(Schema):
    """Limits on an estimate's validity; the first limit reached ends it."""

    date: str
    """UTC"""
    odometer: float | None = None
    """Total distance driven, m; None: not limited by distance"""
    part: str = ""
    """Measured device and its port; another device or another port ends the validity"""
    serial: str = ""
    """USB serial number of the device; empty: unknown"""


class Result(Schema):
    """Result of one wizard run."""

    wizard: WizardName
    date: Date = ""
    """Date of the latest estimate; set when it is saved"""
    measured: str
    """Description of the procedure, as a sentence"""
    confidence: float = CONFIDENCE
    """Confidence level of the intervals"""
    estimates: Annotated[tuple[Estimate, ...], Field(min_length=1)]
    unobserved: tuple[str, ...] = ()
    """Quantities that this measurement cannot determine"""
    readings: tuple[tuple[float, ...], ...] = ()
    """Raw readings that a later run may reuse; the wizard defines their meaning"""
    partial: bool = False
    """Whether only these estimates were measured, so that other estimates of the previous run are kept"""
    again: str | None = None
    """Remaining steps until the calibration is complete"""

    def over(self, before: "Result | None", date: str, file: int = 0) -> "Result":
        """Return this result as saved on ``date`` in file ``number``, with estimates kept from ``before``."""
        fresh = tuple(e.model_copy(update={"date": e.date or date, "file": file}) for e in self.estimates)
        names = {estimate.name for estimate in fresh}
        old = before.estimates if self.partial and before is not None else ()
        kept = tuple(estimate for estimate in old if estimate.name not in names)
        return self.model_copy(update={"date": date, "estimates": fresh + kept})

    def estimate(self, name: str) -> Estimate | None:
        """Return the estimate with this name."""
        return next((estimate for estimate in self.estimates if estimate.name == name), None)

    def number(self, name: str) -> float:
        """Value of an estimate that must exist and be a number."""
        estimate = self.estimate(name)
        assert estimate is not None
        return float(estimate.value)


class CalibrationFile(Schema):
    """All calibration results for one truck; replaced as a unit, never modified."""

    version: Literal[1] = 1
    number: Annotated[int, Field(ge=1)]
    """Number of the file"""
    robot: str
    written: str
    """UTC, by the robot's clock"""
    change: str
    """Differences from the previous file"""
    results: dict[WizardName, Result]


def utc(real_ns: int) -> str:
    """Format a real (UNIX) time in ns as ``YYYY-MM-DDThh:mm:ssZ``."""
    return f"{np.datetime64(real_ns // SECOND, 's')}Z"


_FILE_NAME: Final = re.compile(r"(\d{4,})-[0-9TZ-]+\.json")


class CalibrationStore:
    """Reads and writes the calibration files of one truck; every method may block for file access.

    Args:
        folder: folder for the files, created when the first file is written.
        robot: name of the truck.
    """

    def __init__(self, folder: Path, robot: str) -> None:
        self.folder = folder
        self._robot = robot
        self._writing = threading.Lock()

    def files(self) -> list[Path]:
        """All files, oldest first.

        Raises:
            ConfigError: the folder cannot be read.
        """
        try:
            names = [path for path in self.folder.iterdir() if _FILE_NAME.fullmatch(path.name)]
        except FileNotFoundError:
            return []
        except OSError as error:
            raise ConfigError(f"{self.folder}: calibration cannot be read: {error.strerror}") from error
        return sorted(names, key=lambda path: (_number(path), path.name))

    def newest(self) -> Path | None:
        """The file in use."""
        return next(reversed(self.files()), None)

    def load(self, path: Path) -> CalibrationFile:
        """Load one file.

        Raises:
            ConfigError: the file is damaged, too large, or another truck's; the message names the file and the remedy.
        """
        try:
            require_file(path, 1_000_000)  # maximum file size
            file = CalibrationFile.model_validate_json(path.read_bytes())
        except Exception as error:
            what = error.strerror if isinstance(error, OSError) else cause_of(error)
            msg = f"{path}: no usable calibration: {what}; move it away to return to the previous one"
            raise UnusableFileError(path, msg) from error
        if file.robot != self._robot:
            raise ConfigError(f"{path}: robot: calibration of {file.robot!r}, expected {self._robot!r}")
        return file

    def current(self) -> CalibrationFile | None:
        """Content of the latest file; None before the first calibration.

        Raises:
            ConfigError: see ``load``.
        """
        path = self.newest()
        return None if path is None else self.load(path)

    def save(self, result: Result, real_ns: int) -> Path:
        """Write a new file with ``result`` in place of the wizard's previous result; return its path.

        Args:
            result: measured estimates.
            real_ns: current real (UNIX) time (ns).

        Raises:
            ConfigError: the latest file is damaged, or the new file cannot be written; nothing is changed.
        """
        with self._alone():
            current = self.current()
            before = current.results.get(result.wizard) if current is not None else None
            saved = result.over(before, utc(real_ns), 1 if current is None else current.number + 1)
            return self._write({result.wizard: saved}, f"{result.wizard} calibrated", real_ns)

    def undo(self, wizard: WizardName, real_ns: int) -> Path:
        """Write a new file with the wizard's previous result; return its path.

        A second undo redoes the change.

        Raises:
            NotFoundError: this wizard has no result.
            ConfigError: see ``save``.
        """
        with self._alone():
            history = [self.load(path).results.get(wizard) for path in reversed(self.files())]
            if all(result is None for result in history):
                raise NotFoundError(f"{self.folder}: {wizard} was never calibrated: no result to undo")
            before = next((result for result in history if result != history[0]), None)
            change = f"{wizard} as it was " + ("before any calibration" if before is None else f"on {before.date}")
            return self._write({wizard: before}, change, real_ns)

    @contextmanager
    def _alone(self) -> Iterator[None]:
        """Lock out other writers, in any process, while the latest file is read and the next one is written.

        Raises:
            ConfigError: the folder cannot be created or opened.
        """
        with self._writing:
            try:
                make_folder(self.folder)
                folder = os.open(self.folder, os.O_RDONLY | os.O_DIRECTORY)
            except OSError as error:
                raise ConfigError(f"{self.folder}: calibration cannot be written: {error.strerror}") from error
            try:
                fcntl.flock(folder, fcntl.LOCK_EX)
                yield
            finally:
                os.close(folder)

    def _write(self, changed: dict[WizardName, Result | None], change: str, real_ns: int) -> Path:
        current = self.current()
        others = current.results.items() if current is not None else ()
        results = {**{name: result for name, result in others if name not in changed}, **changed}
        number = 1 if current is None else current.number + 1
        file = CalibrationFile(
            number=number,
            robot=self._robot,
            written=utc(real_ns),
            change=change,
            results={name: result for name, result in results.items() if result is not None},
        )
        path = self.folder / f"{number:04d}-{utc(real_ns).replace(':', '')}.json"
        try:
            replace_file(path, file.model_dump_json(indent=1) + "\n")
        except OSError as error:
            raise ConfigError(f"{path}: calibration cannot be written: {error.strerror}") from error
        return path


def _number(path: Path) -> int:
    return int(path.name.partition("-")[0])


def with_values(config: C, results: Iterable[Result], source: Path | str) -> C:
    """Return ``config`` with the values of ``results``; values of missing devices are ignored.

    Args:
        config: configuration, calibrated or not.
        results: results of the wizards.
        source: name used in error messages.

    Raises:
        ConfigError: a wizard may not set a value, or the configuration rejects it.
    """
    data = config.model_dump()
    put_values(data, results, source)
    try:
        return type(config).model_validate(data)
    except ValidationError as error:
        raise ConfigError(f"{source}: {first_mistake(error)}") from error


def put_values(data: dict[str, Any], results: Iterable[Result], source: Path | str) -> None:
    """Put the values of ``results`` into the plain data of a configuration, without validation.

    Raises:
        ConfigError: a wizard may not set a value.
    """
    for result, _, estimate in in_order(results):
        _set(data, estimate, result, source)


def in_order(results: Iterable[Result]) -> list[tuple[Result, int, Estimate]]:
    """Return the estimates that set a value, each with its result and its index in the result, latest last.

    A partial measurement keeps old estimates, which may be older than another wizard's. If two wizards set one value,
    the newer estimate is used.
    """
    rows = [(result, k, e) for result in results for k, e in enumerate(result.estimates) if e.key is not None]
    return sorted(rows, key=lambda row: (row[2].file, "" if row[2].file else row[2].date or row[0].date))


def unused(config: TruckConfig, results: Iterable[Result]) -> list[str]:
    """Keys of calibrated values that have no place in ``config`` because the device is missing or renamed."""
    data = config.model_dump()
    keys = [estimate.key for _, _, estimate in in_order(results) if estimate.key is not None]
    return [key for key in dict.fromkeys(keys) if _section(data, key) is None]


def _set(data: dict[str, Any], estimate: Estimate, result: Result, source: Path | str) -> None:
    assert estimate.key is not None
    if not may_set(result.wizard, estimate.key):
        raise ConfigError(f"{source}: the wizard {result.wizard} may not set {estimate.key}")
    if (section := _section(data, estimate.key)) is not None:
        section[estimate.key.rpartition(".")[2]] = estimate.value


def _section(data: dict[str, Any], key: str) -> dict[str, Any] | None:
    """Return the mapping that contains ``key``; None if the configuration has no such section."""
    section = data
    for part in key.split(".")[:-1]:
        inner = section.get(part)
        if not isinstance(inner, dict):
            return None
        section = inner
    return section


def may_set(wizard: WizardName, key: str) -> bool:
    """Return whether a wizard may set a value in the configuration, according to ``WizardKind.keys``."""
    names = key.split(".")
    return any(fits(names, pattern) for pattern in WIZARDS[wizard].keys)


def value_at(config: Mapping[str, Any], key: str) -> Value | None:
    """Return a value from a resolved configuration; None if its section is missing."""
    section: Any = config
    for part in key.split("."):
        if not isinstance(section, Mapping):
            return None
        section = section.get(part)
    return section if isinstance(section, bool | int | float) else None
