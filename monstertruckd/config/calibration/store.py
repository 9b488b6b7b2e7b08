"""The folder of a truck's calibration files.

Files are numbered and dated, ``0003-2026-11-21T160102Z.json``; the newest counts. A file is written under another name,
synced and then renamed, so that after any crash the newest one is whole. No file is ever changed or removed: the one
before is always there, and undoing is writing a newer file with the older value.
"""

import os
import re
import threading
from pathlib import Path
from typing import Final

from pydantic import ValidationError

from monstertruck_runtime.errors import ConfigError, NotFoundError
from monstertruckd.config.calibration.record import CalibrationFile, Result, WizardName, utc

_NAME: Final = re.compile(r"(\d{4,})-[0-9TZ-]+\.json")


class CalibrationStore:
    """Reads and writes the files of one truck; every method may block for a file system's time.

    Args:
        folder: made when the first file is written.
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
            names = [path for path in self.folder.iterdir() if _NAME.fullmatch(path.name)]
        except FileNotFoundError:
            return []
        except OSError as error:
            raise ConfigError(f"{self.folder}: calibration cannot be read: {error.strerror}") from error
        return sorted(names, key=_number)

    def newest(self) -> Path | None:
        """The file that counts."""
        return next(reversed(self.files()), None)

    def load(self, path: Path) -> CalibrationFile:
        """Read one file.

        Raises:
            ConfigError: it is damaged, or of another truck; names the file and what to do.
        """
        try:
            file = CalibrationFile.model_validate_json(path.read_bytes())
        except (OSError, ValidationError) as error:
            what = error.strerror if isinstance(error, OSError) else _first_mistake(error)
            msg = f"{path}: no usable calibration: {what}; move it away to go back to the one before"
            raise ConfigError(msg) from error
        if file.robot != self._robot:
            raise ConfigError(f"{path}: robot: is the calibration of {file.robot!r}, this is {self._robot!r}")
        return file

    def current(self) -> CalibrationFile | None:
        """Content of the newest file; None before the first calibration.

        Raises:
            ConfigError: see ``load``.
        """
        path = self.newest()
        return None if path is None else self.load(path)

    def save(self, result: Result, real_ns: int) -> Path:
        """Write a new file in which ``result`` replaces the wizard's last one; returns its path.

        Args:
            result: what was measured.
            real_ns: real time now.

        Raises:
            ConfigError: the newest file is damaged, or the new one cannot be written; nothing has changed then.
        """
        with self._writing:
            current = self.current()
            before = current.results.get(result.wizard) if current is not None else None
            saved = result.over(before, utc(real_ns))
            return self._write({result.wizard: saved}, f"{result.wizard} calibrated", real_ns)

    def undo(self, wizard: WizardName, real_ns: int) -> Path:
        """Write a new file with the wizard's result as it was before its last change; returns its path.

        Undoing twice is doing it again.

        Raises:
            NotFoundError: this wizard has never changed anything.
            ConfigError: see ``save``.
        """
        with self._writing:
            history = [self.load(path).results.get(wizard) for path in reversed(self.files())]
            if all(result is None for result in history):
                raise NotFoundError(f"{self.folder}: {wizard} was never calibrated, there is nothing to undo")
            before = next((result for result in history if result != history[0]), None)
            change = f"{wizard} as it was " + ("before any calibration" if before is None else f"on {before.date}")
            return self._write({wizard: before}, change, real_ns)

    def _write(self, changed: dict[WizardName, Result | None], change: str, real_ns: int) -> Path:
        current = self.current()
        results = {**(current.results if current is not None else {}), **changed}
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
            self._put(path, file.model_dump_json(indent=1).encode() + b"\n")
        except OSError as error:
            raise ConfigError(f"{path}: calibration cannot be written: {error.strerror}") from error
        return path

    def _put(self, path: Path, data: bytes) -> None:
        self.folder.mkdir(parents=True, exist_ok=True)
        draft = path.with_suffix(".new")
        with draft.open("wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        draft.replace(path)
        directory = os.open(self.folder, os.O_RDONLY | os.O_DIRECTORY)
        try:
            os.fsync(directory)
        finally:
            os.close(directory)


def _number(path: Path) -> int:
    return int(path.name.partition("-")[0])


def _first_mistake(error: ValidationError) -> str:
    detail = error.errors(include_url=False)[0]
    return f"{'.'.join(map(str, detail['loc'])) or 'file'}: {detail['msg'][:1].lower()}{detail['msg'][1:]}"
