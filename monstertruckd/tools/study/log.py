"""Finds the open-loop runs of a log, with the stand's poses."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from monstertruck_kinematics.elementary import Array
from monstertruck_runtime.clock import SECOND
from monstertruck_runtime.errors import InputError, NotFoundError, TruckError
from monstertruck_schemas.base import Message
from monstertruck_schemas.req import DriveRequest
from monstertruck_schemas.sensor import StandPose
from monstertruck_schemas.topics import REQ_DRIVE, STAND_POSE
from monstertruckd.recorder.reader import LogReader, open_log
from monstertruckd.tools.study.runs import SETTLING

EQUAL: Final = 1e-6
"""Rad/s."""


@dataclass(frozen=True)
class Run:
    """One run: requests and poses."""

    left: float
    """Rate of the left wheels, rad/s; for a line, of the first pass."""
    right: float
    times: Array
    """Times of the poses since the run's begin, s; (n,)."""
    poses: Array
    """(3, n): x, y (m), heading (rad)."""
    directions: Array
    """(n,): sign of the rates requested at each pose."""

    @property
    def straight(self) -> bool:
        """Whether both sides turn at the same rate, so that the robot drives straight."""
        return abs(self.left - self.right) < EQUAL

    @property
    def name(self) -> str:
        """Description in words."""
        fast, slow = max(abs(self.left), abs(self.right)), min(abs(self.left), abs(self.right))
        if self.straight:
            return f"line, {fast:.2f} rad/s"
        return f"one side locked, {fast:.2f} rad/s" if slow < EQUAL else f"{fast / slow:.3g}:1, {fast:.2f} rad/s"


def read_runs(log: Path | LogReader) -> tuple[list[Run], dict[str, Any]]:
    """All runs of a log, and the robot's configuration as plain values.

    Raises:
        NotFoundError: no such file.
        InputError: it is not a log, or has no run by shaft speeds, or no poses of a stand, or an invalid one of either.
    """
    reader = open_log(log)
    path = reader.path
    asked: list[tuple[int, float, float]] = []
    seen: list[tuple[int, float, float, float]] = []
    for message in _messages(reader):
        if isinstance(message, DriveRequest) and message.shafts is not None and len(message.shafts) > 1:
            asked.append((message.received, message.shafts[0], message.shafts[1]))
        elif isinstance(message, StandPose):
            seen.append((message.stamp, message.pose.x, message.pose.y, message.pose.yaw))
    if not asked:
        raise InputError(f"{path}: no client drove by shaft speeds (`study circle`, `study straight`)")
    if not seen:
        raise InputError(f"{path}: contains no poses of a test stand: expected `stand: simulator` or `overhead`")
    return [_run(part, np.array(seen)) for part in _parts(asked)], reader.config()


def _messages(reader: LogReader) -> Iterator[Message]:
    """Requests and poses; other schemas are skipped."""
    for entry in reader:
        if entry.topic in (REQ_DRIVE.name, STAND_POSE.name):
            try:
                yield entry.decode()
            except NotFoundError:
                continue
            except TruckError as error:
                raise InputError(f"{reader.path}: {entry.topic} number {entry.sequence}: {error}") from error


def _parts(asked: list[tuple[int, float, float]]) -> Iterator[list[tuple[int, float, float]]]:
    """Requests of one run each: rates that differ only in sign, pauses in between."""
    part: list[tuple[int, float, float]] = []
    for request in asked:
        # 3 * SECOND: requests further apart are of two runs, ns
        if part and (request[0] - part[-1][0] > 3 * SECOND or _other(part, request)):
            yield part
            part = []
        if part or request[1] or request[2]:
            part.append(request)
    if part:
        yield part


def _other(part: list[tuple[int, float, float]], request: tuple[int, float, float]) -> bool:
    _, left, right = request
    _, first, second = part[0]
    return bool(left or right) and (
        abs(abs(left) - abs(first)) > EQUAL or abs(abs(right) - abs(second)) > EQUAL or left * second != right * first
    )


def _run(part: list[tuple[int, float, float]], seen: Array) -> Run:
    while not (part[-1][1] or part[-1][2]):
        part = part[:-1]  # at rest after the run
    stamps = np.array([request[0] for request in part], np.float64)
    signs = np.array([np.sign(request[1] + request[2]) for request in part])
    _, left, right = part[0]
    straight = abs(left - right) < EQUAL
    begin = stamps[0] + (0.0 if straight else SETTLING * SECOND)
    inside = (seen[:, 0] >= begin) & (seen[:, 0] <= stamps[-1])
    when = seen[inside, 0]
    directions = signs[np.clip(np.searchsorted(stamps, when, "right") - 1, 0, None)] if when.size else when
    return Run(left, right, (when - stamps[0]) / SECOND, seen[inside, 1:].T, directions)
