"""Mutated user files: each is read or refused, within 5 s and 500 MB, without a library's traceback.

``kinds.py`` defines the kinds. Some mutations know no format (flips, holes, cuts, repeated blocks, noise), others know
a little of it, so that they pass the first checks: numbers and words are replaced; archives, packed files and logs are
changed inside and packed again, with valid checksums. A file depends only on its number and the seed: any part of a run
can be repeated.

The time of a file is its time on an idle computer: the larger of the processor time of the process, and the elapsed
time minus the time for which its main thread waited for a processor, as counted by the kernel. Its memory is what
reading adds to that of a command: this process has loaded the libraries of all commands.
"""

import faulthandler
import gzip
import io
import json
import logging
import os
import random
import re
import shutil
import subprocess
import sys
import time
import traceback
import warnings
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final, NamedTuple

from mcap.reader import make_reader
from mcap.writer import Writer

from benchmarks.durability_parts.kinds import Kind, kinds
from monstertruck_runtime.clock import SECOND
from monstertruck_runtime.errors import TruckError
from monstertruckd.recorder.frames import MAGIC

SECONDS: Final = 5.0
MEGABYTES: Final = 500.0
LOADED: Final = 170.0
"""Memory of the process of `map build` before it reads a file (MB)."""
HANGS: Final = 1800.0
"""Elapsed seconds after which a reader is taken for hung: its stack is printed, and the run ends."""
SHOWN: Final = 30
"""Faults that are printed, one of each kind and place."""
WORDS: Final = (b"-1", b"0", b"1e999", b"nan", b"null", b"[]", b"{}", b"''", b"true", b"4294967296", b"1e-320", b"\xff")
"""What numbers and words are replaced by."""


# Mutations


def damaged(data: bytes, rng: random.Random) -> bytes:
    """Mutate a file as it is, or every other packed one inside."""
    unpack = next((unpack for begin, unpack in PACKINGS.items() if data.startswith(begin)), None)
    return unpack(data, rng) if unpack is not None and rng.random() < 0.5 else mutated(data, rng)


def _in_archive(data: bytes, rng: random.Random) -> bytes:
    """Mutate a member of an archive."""
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    victim, out = rng.choice(list(members)), io.BytesIO()
    with zipfile.ZipFile(out, "w") as archive:
        for name, content in members.items():
            archive.writestr(name, mutated(content, rng) if name == victim else content)
    return out.getvalue()


def _in_log(data: bytes, rng: random.Random) -> bytes:
    """Mutate some messages, or an attachment, of a log; one without an index is mutated as it is."""
    if not data.endswith(MAGIC):
        return mutated(data, rng)
    reader, out = make_reader(io.BytesIO(data)), io.BytesIO()
    writer = Writer(out, use_chunking=True)
    writer.start()
    for record in reader.iter_metadata():
        writer.add_metadata(record.name, record.metadata)
    attachments = list(reader.iter_attachments())
    victim = rng.choice(attachments) if attachments and rng.random() < 0.3 else None
    for each in attachments:
        content = mutated(each.data, rng) if each is victim else each.data
        writer.add_attachment(each.create_time, each.log_time, each.name, each.media_type, content)
    schemas, channels, some = dict[int, int](), dict[int, int](), rng.choice((0.0, 0.01, 0.3)) if victim else 0.1
    for schema, channel, message in reader.iter_messages(log_time_order=False):
        if channel.id not in channels:
            if schema is not None and schema.id not in schemas:
                schemas[schema.id] = writer.register_schema(schema.name, schema.encoding, schema.data)
            known = 0 if schema is None else schemas[schema.id]
            channels[channel.id] = writer.register_channel(channel.topic, channel.message_encoding, known)
        content = mutated(message.data, rng) if rng.random() < some else message.data
        times = message.log_time, content, message.publish_time, message.sequence
        writer.add_message(channels[channel.id], *times)
    writer.finish()
    return out.getvalue()


PACKINGS: Final[dict[bytes, Callable[[bytes, random.Random], bytes]]] = {
    b"PK\x03\x04": _in_archive,
    b"\x1f\x8b": lambda data, rng: gzip.compress(mutated(gzip.decompress(data), rng)),
    MAGIC: _in_log,
}
"""What changes the inside of a packed file, by its first bytes."""


def mutated(data: bytes, rng: random.Random) -> bytes:
    """Apply one to three changes."""
    for _ in range(rng.randint(1, 3)):
        if not data:
            return data
        begin = rng.randrange(len(data))
        end = min(begin + int(2 ** rng.uniform(0, 12)), len(data))
        block, at = data[begin:end], rng.randrange(len(data))
        match rng.randrange(10):
            case 0 | 1:
                data = data[:begin] + bytes([data[begin] ^ 1 << rng.randrange(8)]) + data[begin + 1 :]
            case 2:
                data = data[:begin] + bytes(len(block)) + data[end:]
            case 3:
                data = data[:end]
            case 4:
                data = data[:at] + block + data[at:]
            case 5:
                data = data[:begin] + rng.randbytes(len(block)) + data[end:]
            case 6:
                data = data[:begin] + data[end:]
            case 7:
                data = data[:begin] + rng.choice((b"\xff\xff\xff\x7f", b"\0\0\0\x80", b"\xff" * 8)) + data[begin + 4 :]
            case _:
                data = _reworded(data, rng)
    return data


def _reworded(data: bytes, rng: random.Random) -> bytes:
    """Replace a number or word."""
    words = list(re.finditer(rb"-?[\w.]+", data[:20_000]))
    if not words:
        return data
    word = rng.choice(words)
    other = rng.choice((*WORDS, rng.choice(words).group() + b"0" * rng.choice((0, 1, 20, 400))))
    return data[: word.start()] + other + data[word.end() :]


# Runs


def peak() -> float:
    """Return the peak memory of this process since the last reset (MB)."""
    return int(Path("/proc/self/status").read_text(encoding="ascii").split("VmHWM:")[1].split()[0]) / 1000


def reset_peak() -> None:
    """Reset ``peak``."""
    Path("/proc/self/clear_refs").write_text("5", encoding="ascii")


class Spent(NamedTuple):
    """Times at an instant (s)."""

    elapsed: float
    processor: float
    """Processor time of the process and of its ended children."""
    waited: float
    """Time for which the main thread could run and had no processor."""

    @classmethod
    def now(cls) -> "Spent":
        """Read the clocks of this process."""
        waited = int(Path("/proc/self/schedstat").read_text(encoding="ascii").split()[1])
        return cls(time.perf_counter(), sum(os.times()[:4]), waited / SECOND)

    def since(self, begin: "Spent") -> float:
        """Return the time that the same work would take on an idle computer (s)."""
        elapsed = self.elapsed - begin.elapsed - (self.waited - begin.waited)
        return max(elapsed, self.processor - begin.processor)


def run(first: int, count: int, seed: int, work: Path) -> dict[str, Any]:
    """Mutate and read files from number ``first`` on; return figures by kind."""
    known = kinds()
    figures = {
        name: {"files": 0, "read": 0, "faults": 0, "seconds": 0.0, "slowest": first, "megabytes": 0.0} for name in known
    }
    names, shares = list(known), [kind.share for kind in known.values()]
    seen: set[str] = set()
    warnings.simplefilter("ignore")
    logging.disable()
    sound: dict[str, dict[str, bytes]] = {}
    for number in range(first, first + count):
        faulthandler.dump_traceback_later(HANGS, exit=True)
        rng = random.Random(f"{seed} {number}")
        name = rng.choices(names, shares)[0]
        kind, row = known[name], figures[name]
        folder = work / ("f" * (1 + number % 2))
        key = f"{name} {number % 2}"
        folder.mkdir(parents=True)
        if key not in sound:
            sound[key] = _made(kind, folder)
        for place, data in sound[key].items():
            (folder / place).parent.mkdir(parents=True, exist_ok=True)
            (folder / place).write_bytes(data)
        victim = folder / rng.choice(list(sound[key]))
        victim.write_bytes(damaged(victim.read_bytes(), rng))
        fault, seconds, megabytes = _try(kind, folder)
        row["files"] += 1
        row["read"] += fault is None
        row["seconds"], row["slowest"] = max((row["seconds"], row["slowest"]), (seconds, number))
        row["megabytes"] = max(row["megabytes"], megabytes)
        if seconds > SECONDS or megabytes > MEGABYTES:
            fault = f"{seconds:.1f} s, {megabytes:.0f} MB"
        if fault:
            row["faults"] += 1
            if fault not in seen and len(seen) < SHOWN:
                seen.add(fault)
                print(f"{name}, file {number} ({victim.name}): {fault}", file=sys.stderr, flush=True)
        shutil.rmtree(folder)
    faulthandler.cancel_dump_traceback_later()
    return {name: {key: round(value, 2) for key, value in row.items()} for name, row in figures.items()}


def _made(kind: Kind, folder: Path) -> dict[str, bytes]:
    """Return intact files of a kind by place in ``folder``, which is empty before and after; each was read once."""
    kind.make(folder)
    files = (file for file in folder.rglob("*") if file.is_file() and not file.is_symlink())
    sound = {str(file.relative_to(folder)): file.read_bytes() for file in files}
    kind.read(folder)
    shutil.rmtree(folder)
    folder.mkdir()
    return sound


def _try(kind: Kind, folder: Path) -> tuple[str | None, float, float]:
    """Return a library's exception ("": ours, None: it was read), seconds, peak memory (MB)."""
    reset_peak()
    loaded, begin, fault = peak(), Spent.now(), None
    try:
        kind.read(folder)
    except TruckError:
        fault = ""
    except Exception as error:  # noqa: BLE001 - whatever comes is a finding
        last = traceback.extract_tb(error.__traceback__)
        ours = [frame for frame in last if "site-packages" not in frame.filename][-1]
        fault = f"{type(error).__name__}: {str(error)[:120]} at {ours.filename[-50:]}:{ours.lineno}"
    return fault, Spent.now().since(begin), LOADED + peak() - loaded


def run_apart(count: int, seed: int, work: Path, first: int = 0) -> dict[str, Any]:
    """Run in a separate process: a crash of the process by a library is a fault as well."""
    command = [sys.executable, "-m", "benchmarks.durability_parts.files", *map(str, (first, count, seed, work))]
    done = subprocess.run(command, stdout=subprocess.PIPE, check=False)
    shutil.rmtree(work, ignore_errors=True)
    if done.returncode:
        return {"all": {"files": 0, "faults": 1, "status": done.returncode}}
    figures: dict[str, Any] = json.loads(done.stdout)
    return figures


if __name__ == "__main__":
    begin, number, chosen = map(int, sys.argv[1:4])
    print(json.dumps(run(begin, number, chosen, Path(sys.argv[4]))))
