"""Kills and power cuts: run a subject's writer, end it at any point, and check what remains."""

import os
import random
import shutil
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

from benchmarks.durability_parts import maps, recordings, state
from benchmarks.durability_parts.disk import ACKNOWLEDGED, Disk, compiled, events, traced
from benchmarks.durability_parts.subject import Death, Subject

SUBJECTS: Final[tuple[Subject, ...]] = (recordings.SUBJECT, maps.SUBJECT, *state.SUBJECTS)
SHOWN: Final = 5
"""Faults of a subject that are printed."""
TRACES: Final = 8
"""Cuts of one traced run."""


def kills(subjects: Sequence[Subject], count: int, seed: int, work: Path) -> dict[str, Any]:
    """Kill writers ``count`` times, subject by subject in turn; return figures by subject.

    A writer is a fork of this process, which must have no other thread.
    """
    rng, faults, done = random.Random(seed), Counter[str](), Counter[str]()
    for number in range(count):
        subject = subjects[number % len(subjects)]
        folder = work / "kill"
        folder.mkdir(parents=True)
        acknowledged = _killed(subject, folder, seed + number, rng.uniform(0.0, subject.seconds))
        _judge(subject, folder, acknowledged, Death.KILL, faults)
        done[subject.name] += 1
        shutil.rmtree(folder)
    return {name: {"kills": done[name], "faults": faults[name]} for name in done}


def _killed(subject: Subject, folder: Path, seed: int, seconds: float) -> list[str]:
    """Let a writer work for a while and kill it; return its acknowledgements."""
    begun, begin = os.pipe()
    child = os.fork()
    if child == 0:
        status = 1
        try:
            os.close(begun)
            work(subject, folder, seed, begin)
            status = 0
        finally:
            os._exit(status)
    os.close(begin)
    os.read(begun, 1)
    os.close(begun)
    time.sleep(seconds)
    os.kill(child, signal.SIGKILL)
    _, status = os.waitpid(child, 0)
    if os.WIFEXITED(status) and os.WEXITSTATUS(status):
        raise RuntimeError(f"the writer of {subject.name} failed")
    return _lines((folder / ACKNOWLEDGED).read_bytes())


def work(subject: Subject, folder: Path, seed: int, begin: int | None = None, most: int | None = None) -> None:
    """Run a subject's writer.

    Args:
        subject: subject to write.
        folder: output folder.
        seed: seed of the changes.
        begin: descriptor that receives a byte before the first change.
        most: number of acknowledged changes; None: until it is killed, or has no more.
    """
    notes = os.open(folder / ACKNOWLEDGED, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600)
    if begin is not None:
        os.write(begin, b"!")
    for number, line in enumerate(subject.write(folder, seed), start=1):
        os.write(notes, line.encode() + b"\n")
        if number == most:
            break


def cuts(subjects: Sequence[Subject], count: int, seed: int, work: Path) -> dict[str, Any]:
    """Cut the power ``count`` times, subject by subject in turn; return figures by subject.

    Raises:
        FileNotFoundError: there is no C compiler.
    """
    work.mkdir(parents=True, exist_ok=True)
    library = compiled(work)
    rng, faults, done = random.Random(seed), Counter[str](), Counter[str]()
    while sum(done.values()) < count:
        for subject in subjects:
            wanted = min(TRACES, count - sum(done.values()))
            _cut(subject, library, work, rng, wanted, faults)
            done[subject.name] += wanted
    return {name: {"cuts": done[name], "faults": faults[name]} for name in done if done[name]}


def _cut(subject: Subject, library: Path, work: Path, rng: random.Random, count: int, faults: Counter[str]) -> None:
    folder, trace = work / "traced", work / "trace"
    folder.mkdir()
    command = [sys.executable, "-m", "benchmarks.durability_parts.writer", subject.name, str(folder)]
    command += [str(rng.randrange(2**31)), str(subject.changes)]
    subprocess.run(command, env=traced(library, folder, trace), check=True)
    happened = list(events(trace.read_bytes()))
    points, disk = sorted(rng.sample(range(len(happened) + 1), min(count, len(happened)))), Disk(folder)
    for number, event in enumerate(happened):
        if points and number == points[0]:
            points.pop(0)
            left = work / "left"
            disk.leave(left, rng)
            _judge(subject, left, _lines(disk.acknowledged), Death.CUT, faults)
            shutil.rmtree(left)
        disk.play(event)
    shutil.rmtree(folder)
    trace.unlink()


def _lines(data: bytes) -> list[str]:
    """Return the complete lines."""
    return [line.decode() for line in data.split(b"\n")[:-1]]


def _judge(subject: Subject, folder: Path, acknowledged: list[str], death: Death, faults: Counter[str]) -> None:
    (folder / ACKNOWLEDGED).unlink(missing_ok=True)
    try:
        wrong = subject.check(folder, acknowledged, death)
    except Exception as error:  # noqa: BLE001 - whatever the reader raises is a fault
        wrong = f"{type(error).__name__}: {error}"
    if wrong is not None:
        faults[subject.name] += 1
        if faults[subject.name] <= SHOWN:
            print(f"{subject.name}, {death}, {len(acknowledged)} acknowledged: {wrong}", file=sys.stderr)
