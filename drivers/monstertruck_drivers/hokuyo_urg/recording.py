"""Replay of a recorded drive by the emulated scanner: each scan is sent once, at its recorded time."""

import asyncio
from pathlib import Path
from typing import Any, Final, Self

import numpy as np
from numpy.typing import NDArray

from monstertruck_drivers.hokuyo_urg.emulator import HokuyoEmulator, StartState
from monstertruck_runtime.clock import Clock
from monstertruck_runtime.errors import InputError
from monstertruck_runtime.outside import lines_of, reading

COLUMNS: Final = 707
STEPS: Final = range(43, 726)
"""Steps of the recorded scanner."""


class RecordedRanges:
    """Scans of a recorded drive; usable as a ``RangeSource`` once :meth:`start` has set the start time.

    Args:
        times: time of step 0 of each revolution (ns since the first scan), increasing, shape (n,).
        ranges: shape (n, 683), mm or error codes, steps 43..725.
    """

    def __init__(self, times: NDArray[np.int64], ranges: NDArray[np.int32]) -> None:
        self.times = times
        self.ranges = ranges
        self._begin = 0

    def __len__(self) -> int:
        return len(self.times)

    @classmethod
    def load(cls, path: Path) -> Self:
        """Read a text file, optionally gzipped, in the format of the BreezySLAM examples.

        Each line is one scan of 707 space-separated numbers: column 0 is the time in microseconds, 24..706 are ranges
        in mm.

        Raises:
            InputError: the file does not exist or a line does not have this form.
        """
        times: list[int] = []
        rows: list[NDArray[np.int32]] = []
        expected = f"a recording of {COLUMNS} numbers a line"
        with reading(path, expected):
            for number, line in enumerate(lines_of(path, expected), start=1):
                time, row = _parse(line, f"{path}:{number}")
                if times and time <= times[-1]:
                    raise InputError(f"{path}:{number}: time {time} does not increase")
                times.append(time)
                rows.append(row)
        if not rows:
            raise InputError(f"{path}: contains no scans")
        return cls((np.array(times, np.int64) - times[0]) * 1000, np.array(rows, np.int32))

    def start(self, time_ns: int) -> None:
        """Start the recording: step 0 of the first scan is at ``time_ns``."""
        self._begin = time_ns

    def scan(self, time_ns: int) -> NDArray[np.int32]:
        """Return the recorded revolution that started nearest to ``time_ns``; shape (769,), zero where not recorded."""
        at = int(np.searchsorted(self.times, time_ns - self._begin))
        near = [i for i in (at - 1, at) if 0 <= i < len(self.times)]
        best = min(near, key=lambda i: abs(int(self.times[i]) - (time_ns - self._begin)))
        steps = 769
        values = np.zeros(steps, np.int32)
        values[STEPS.start : STEPS.stop] = self.ranges[best]
        return values


def _parse(line: str, where: str) -> tuple[int, NDArray[np.int32]]:
    words = line.split()
    if len(words) != COLUMNS:
        raise InputError(f"{where}: expected {COLUMNS} numbers, found {len(words)}")
    try:
        time_column = 0
        first_range_column = 24
        time, row = int(words[time_column]), np.array(words[first_range_column:], np.int64)
    except ValueError as error:
        raise InputError(f"{where}: expected whole numbers: {error}") from error
    greatest = (1 << 18) - 1  # maximum of three characters, mm
    if row.min() < 0 or row.max() > greatest:
        raise InputError(f"{where}: expected ranges within 0..{greatest} mm")
    return time, row.astype(np.int32)


class RecordedHokuyoEmulator(HokuyoEmulator):
    """Scanner whose revolutions start at the recorded times; it reports steps 43..725 like the recorded scanner.

    The first request for a stream starts the recording, which then plays once, with or without a client.

    Args:
        clock: world time.
        recording: scans with their times.
        seed: seed for the USB jitter.
        state: initial state; ``streaming`` starts the recording immediately.
        options: further ``HokuyoEmulator`` options.
    """

    def __init__(
        self, clock: Clock, recording: RecordedRanges, *, seed: int = 0, state: StartState = "scip1", **options: Any
    ) -> None:
        self.finished = asyncio.Event()
        """Set once the last recorded scan was sent."""
        self.began: int | None = None
        """World time at step 0 of the first recorded scan (ns)."""
        self._recording = recording
        self._wanted = asyncio.Event()
        self._first = 0
        self._index = -1
        options |= {"min_step": STEPS[0], "max_step": STEPS[-1]}
        super().__init__(clock, recording, seed=seed, state=state, **options)
        if state == "streaming":
            self._wanted.set()

    async def _next_revolution(self, previous: int | None) -> int | None:
        if previous is None:
            await self._wanted.wait()
            lead = 10_000_000  # nanoseconds from the scan request to step 0 of the first recorded scan
            self._first = self._time() + lead
            self._recording.start(self._first)
            self.began = self._world_time(self._first)
        self._index += 1
        if self._index == len(self._recording):
            self.finished.set()
            return None
        return self._first + int(self._recording.times[self._index])

    def _measure(self, begin: int) -> NDArray[np.int32]:
        # Sensor time, which may drift from world time.
        return self._recording.scan(begin)

    def _latest_revolution(self) -> int:
        age = self._time() - self._sweep() - self._first
        complete = int(np.searchsorted(self._recording.times, age, side="right")) - 1
        return self._first + int(self._recording.times[max(complete, 0)])

    def _multi(self, text: str, tag: str) -> tuple[str, list[bytes]]:
        answer = super()._multi(text, tag)
        if answer[0] == "00":
            self._wanted.set()
        return answer
