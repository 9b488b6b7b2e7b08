"""Downloads of a robot's recordings to local files."""

import base64
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from monstertruck_runtime.client import TruckClient
from monstertruck_runtime.errors import InputError, NotFoundError
from monstertruck_runtime.threads import in_thread


@dataclass(frozen=True, slots=True)
class Fetched:
    """A recording that was fetched to the end it had then."""

    bytes: int
    open: bool
    """Whether the robot was still writing it."""


async def fetch_recording(
    truck: TruckClient, name: str, to: Path, progress: Callable[[float], object], most: int | None = None
) -> Fetched:
    """Fetch a recording into a file, resuming an earlier part.

    The robot limits the rate.

    Args:
        truck: session with the robot.
        name: name of the recording.
        to: file; created when the first bytes arrive.
        progress: called with the fraction fetched, 0..1.
        most: maximum size (bytes); None for no limit.

    Raises:
        InputError: the recording is larger than ``most``, or the existing file is longer or different.
        TruckError: the robot refuses, is absent, or has no such recording.
    """
    held = await in_thread(lambda: to.stat().st_size if to.exists() else 0)
    at = max(held - 4096, 0)  # bytes of the earlier part that are compared with the robot's before resuming
    end = await in_thread(partial(_read, to, at)) if held else b""
    while True:
        answer = await truck.call("recording_read", {"name": name, "offset": at})
        data, size = base64.b64decode(answer["data"]), int(answer["bytes"])
        if most is not None and size > most:
            raise InputError(f"{name}: {size / 1e6:.0f} MB: expected at most {most / 1e6:.0f} MB")
        if held > size:
            raise InputError(f"{to}: {held} bytes: expected the beginning of {name}, which has {size}")
        if not data.startswith(end):
            raise InputError(f"{to}: is not the beginning of {name}; move it away, or fetch to another file")
        end = b""
        await in_thread(partial(put, to, at, data))
        at += len(data)
        progress(at / max(size, 1))
        if at >= size:
            return Fetched(size, answer.get("open", False))
        if not data:
            raise NotFoundError(f"{name}: became shorter while it was fetched")


def _read(file: Path, at: int) -> bytes:
    with file.open("rb") as part:
        part.seek(at)
        return part.read()


def put(file: Path, at: int, data: bytes) -> None:
    """Write at an offset; an earlier write that was abandoned may still be running."""
    file.touch()
    with file.open("r+b") as part:
        part.seek(at)
        part.write(data)
