"""The legs of a drill: each is one truck's share, run in this or several processes, and saved in a file."""

import hashlib
import importlib.util
import json
import logging
import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Generic, TypeVar

from pydantic import TypeAdapter

from monstertruck_runtime.errors import InputError
from monstertruck_runtime.outside import contents_if_present, reading
from monstertruck_runtime.small_files import MEGABYTE
from monstertruckd.tools.simulation.config import SimulatedTruckConfig

Outcome = TypeVar("Outcome")


def default_jobs() -> int:
    """Return the number of a drill's processes: one core is left for other work."""
    return max(len(os.sched_getaffinity(0)) - 1, 1)


@dataclass(frozen=True, slots=True)
class DrillLeg:
    """Share of one truck in a drill; can be sent to another process."""

    config: dict[str, Any]
    """Configuration of the simulated truck, as plain values."""
    seed: int
    number: int
    count: int
    faults: tuple[str, ...] = ()
    """Kinds of faults to draw; empty: all that the robot can have."""

    @property
    def settings(self) -> dict[str, Any]:
        """Return all inputs of a drill's legs, except its seed."""
        return self.config | ({"faults": list(self.faults)} if self.faults else {})


def truck_of_leg(config: SimulatedTruckConfig, seed: int, records: str | None) -> SimulatedTruckConfig:
    """Return the robot of a leg, with its own seed and without a drill; it records to ``records``, if any."""
    keeps = config.recorder is not None and records is not None
    recorder = config.recorder.model_copy(update={"directory": records}) if config.recorder and keeps else None
    blackbox = config.blackbox if keeps else None
    sim = config.sim.model_copy(update={"seed": seed, "drill": None})
    return config.model_copy(update={"recorder": recorder, "blackbox": blackbox, "sim": sim})


class LegFile(Generic[Outcome]):
    """Outcomes of the finished legs of a drill, one JSON object per line, so that an interrupted drill can continue.

    Args:
        path: the file; created if missing.
        leg: any leg of the drill.
        adapter: adapter of a leg's outcomes.

    Raises:
        InputError: the file cannot be read or written, or belongs to another drill or program.
    """

    def __init__(self, path: Path, leg: DrillLeg, adapter: TypeAdapter[list[Outcome]]) -> None:
        self._adapter = adapter
        self._path = path
        self._header = {"seed": leg.seed, "program": _digest(leg.settings)}
        self._found: dict[tuple[int, int], list[Outcome]] = {}
        self._end = 0
        """Size of the complete lines (bytes): an interrupted program leaves an incomplete one."""
        most_bytes = 100 * MEGABYTE  # maximum size of a file of outcomes: a campaign of a million trials
        data = contents_if_present(path, "outcomes of a drill", most_bytes) or b""
        try:
            path.open("ab").close()  # the file must be writable before the first leg, not only after it
        except OSError as error:
            raise InputError(f"{path}: {error.strerror}") from error
        self._end = data.rfind(b"\n") + 1
        for number, line in enumerate(data[: self._end].splitlines(), 1):
            self._read(line, number)

    def _read(self, line: bytes, number: int) -> None:
        with reading(f"{self._path}:{number}", "a leg of a drill"):
            row = json.loads(line)
            header = {key: row[key] for key in self._header}
            outcomes = self._adapter.validate_python(row["outcomes"], strict=False)
            leg = int(row["leg"]), int(row["count"])
        if header != self._header:
            text = f"{self._path}:{number}: is of seed {header['seed']}, or of another program or configuration"
            raise InputError(f"{text}: expected seed {self._header['seed']} and the same program")
        self._found[leg] = outcomes

    def outcomes(self, leg: DrillLeg) -> list[Outcome] | None:
        """Return the outcomes of a finished leg; None if it must be run."""
        return self._found.get((leg.number, leg.count))

    def add(self, leg: DrillLeg, outcomes: list[Outcome]) -> None:
        """Append a finished leg.

        Raises:
            InputError: the file cannot be written.
        """
        row = {**self._header, "leg": leg.number, "count": leg.count}
        line = json.dumps(row | {"outcomes": self._adapter.dump_python(outcomes, mode="json")}).encode() + b"\n"
        try:
            with self._path.open("r+b") as file:
                file.seek(self._end)
                file.write(line)
                file.truncate()
                file.flush()
                os.fsync(file.fileno())
        except OSError as error:
            raise InputError(f"{self._path}: {error.strerror}") from error
        self._end += len(line)


PACKAGES: Final = (
    "monstertruck_schemas",
    "monstertruck_runtime",
    "monstertruck_kinematics",
    "monstertruck_estimation",
    "monstertruck_planners",
    "monstertruck_drivers",
    "monstertruck_sim",
    "monstertruckd",
)


def _digest(config: dict[str, Any]) -> str:
    """Return a hash of all inputs of a leg except seed and number: the configuration and our sources."""
    digest = hashlib.blake2b(repr(config).encode(), digest_size=12)
    for package in PACKAGES:
        spec = importlib.util.find_spec(package)
        assert spec is not None
        for folder in spec.submodule_search_locations or ():
            for source in sorted(Path(folder).rglob("*.py")):
                digest.update(source.read_bytes())
    return digest.hexdigest()


@contextmanager
def without_log() -> Iterator[None]:
    """Disable logging in this process."""
    quiet = logging.root.manager.disable
    logging.disable(logging.CRITICAL)
    try:
        yield
    finally:
        logging.disable(quiet)


def run_legs(
    legs: Sequence[DrillLeg],
    step: Callable[[DrillLeg], list[Outcome]],
    adapter: TypeAdapter[list[Outcome]],
    jobs: int = 1,
    resume: Path | None = None,
    report: Callable[[list[Outcome]], None] = lambda _: None,
) -> tuple[Outcome, ...]:
    """Return the outcomes of all legs in the order of their numbers.

    Args:
        legs: at least one leg.
        step: runs one leg; a function of a module.
        adapter: adapter of a leg's outcomes.
        jobs: number of processes; 1: this one alone.
        resume: file of the outcomes: its legs are not run again, the others are added.
        report: called with the outcomes of each leg.

    Raises:
        InputError: see ``LegFile``.
    """
    file = None if resume is None else LegFile(resume, legs[0], adapter)
    known = {} if file is None else {leg.number: found for leg in legs if (found := file.outcomes(leg))}
    outcomes: list[Outcome] = []
    with _parts([leg for leg in legs if leg.number not in known], step, jobs) as parts:
        for leg in legs:
            part = known.get(leg.number)
            if part is None:
                part = next(parts)
                if file is not None:
                    file.add(leg, part)
            report(part)
            outcomes += part
    return tuple(outcomes)


@contextmanager
def _parts(
    legs: Sequence[DrillLeg], step: Callable[[DrillLeg], list[Outcome]], jobs: int
) -> Iterator[Iterator[list[Outcome]]]:
    if jobs == 1:
        yield map(step, legs)
    else:
        with ProcessPoolExecutor(min(jobs, max(1, len(legs)))) as pool:
            yield pool.map(step, legs)
