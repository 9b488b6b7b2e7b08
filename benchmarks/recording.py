"""Cost of recording, its effect on the control loop, and the loss by a crash.

    python benchmarks/recording.py [--rounds N] [--kills N]

Cost: processor time per 1000 messages of a second's mix (100 poses, 10 scans, 2 images of 100 kB), from ``record()`` to
the closed chunks in the file, compressed by zstd, compared with the Python writer of rosbag 1 (Debian's
``python3-rosbag``, optional), which writes the same bytes, by default uncompressed; both in turn. The cost of the codec
is excluded, because the bus pays it. Both run in the system's Python if it has our version.

Stall: lateness of a 1 ms ticker on the loop that records the mix in real time, compared with the same ticker without
recording; the figure is the difference of the maxima, as the median of the rounds. It is only meaningful on a quiet
machine; therefore the recorder's longest turn is reported, too: the maximum processor time of its thread between two
waits for work, during which it may keep the interpreter from the loop.

Crash: a recording process is killed with SIGKILL at a random instant; the file is repaired as at the next start and
read by the official reader. A power cut is modelled as the loss of everything after the latest fsync, which is what a
disk guarantees. The last line is JSON.
"""

import argparse
import asyncio
import json
import queue
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.same_python import SYSTEM_PYTHON, can_import, go_on_in_the_systems_python
from monstertruck_runtime import wire
from monstertruck_runtime.clock import SECOND, WallClock, run_wall
from monstertruck_schemas.base import Pose2D, Twist2D
from monstertruck_schemas.sensor import CompressedImage, LaserScan
from monstertruck_schemas.state import Odometry
from monstertruck_schemas.topics import CAMERA, POSE, SCAN, Topic
from monstertruckd.recorder.config import Compression, RecorderConfig
from monstertruckd.recorder.log_file import LogFile
from monstertruckd.recorder.reader import open_log
from monstertruckd.recorder.recorder import Recorder
from monstertruckd.recorder.repair import recover

GOALS = {"cpu_over_rosbag": 1.0, "cpu_s_per_1000": 0.018, "stall_ms": 1.0, "unreadable": 0, "worst_loss_s": 1.0}
RATES: dict[Topic[Any], int] = {POSE: 100, SCAN: 10, CAMERA: 2}
SECONDS = 20
"""Duration of the mix in one round of the cost."""
WATCHED = 5.0
"""Seconds of one round of the stall."""
Mix = list[tuple[Topic, bytes]]


def mix() -> Mix:
    """Return a second's messages in the order of their times, encoded."""
    rng = np.random.default_rng(1)
    header: dict[str, Any] = {"stamp": SECOND, "received": SECOND, "seq": 1}
    pose = Odometry(
        **header,
        frame="map",
        child="base",
        pose=Pose2D(x=1.0, y=2.0, yaw=0.3),
        twist=Twist2D(vx=0.2, vy=0.0, wz=0.1),
        pose_covariance=rng.random(9),
        twist_covariance=rng.random(9),
        age=0.01,
        sources=("drive", "steering", "compass"),
    )
    scan = LaserScan(
        **header,
        frame="lidar",
        start_angle=-2.086,
        end_angle=2.086,
        time_increment=0.1 / 1024,
        scan_time=0.1,
        range_min=0.02,
        range_max=5.6,
        ranges=np.round(rng.uniform(0.1, 5.5, 682), 3),
        codes=np.full(682, 255, np.uint8),
    )
    picture = CompressedImage(**header, data=rng.bytes(100_000), sequence=1)
    messages: dict[Topic[Any], Any] = {POSE: pose, SCAN: scan, CAMERA: picture}
    times = sorted((i / rate, topic.name) for topic, rate in RATES.items() for i in range(rate))
    encoded = {topic.name: (topic, wire.encode(topic, message)) for topic, message in messages.items()}
    return [encoded[name] for _, name in times]


def config(folder: Path) -> RecorderConfig:
    """Return the default recorder, with zstd."""
    return RecorderConfig(directory=str(folder), compression=Compression.ZSTD)


def _no_failure(reason: object, text: str) -> None:
    raise RuntimeError(f"{reason}: {text}")


# Cost


async def recorder_cost(clock: WallClock, messages: Mix) -> float:
    """Return processor seconds of all threads per 1000 messages, for ``SECONDS`` of the mix."""
    with tempfile.TemporaryDirectory() as folder:
        async with Recorder(config(Path(folder)), clock, _no_failure) as recorder:
            await clock.sleep(0.2)
            begin = time.process_time()
            for _ in range(SECONDS):
                for topic, data in messages:
                    recorder.record(topic, SECOND, data)
                await clock.sleep(0.02)
        return (time.process_time() - begin) / (SECONDS * len(messages)) * 1000


ROSBAG = """
import sys, tempfile, time
import genpy, rosbag
from geometry_msgs.msg import PoseStamped
from sensor_msgs.msg import CompressedImage, LaserScan
kinds = {"state/pose": PoseStamped, "sensor/scan": LaserScan, "sensor/camera": CompressedImage}
sizes = [line.split() for line in sys.stdin.read().splitlines()]
payload = {name: open(path, "rb").read() for name, path in (line.split("=") for line in sys.argv[2:])}
mix = [(name, payload[name]) for name, in sizes]
with tempfile.TemporaryDirectory() as folder:
    bag = rosbag.Bag(folder + "/a.bag", "w")
    begin = time.process_time()
    for second in range(int(sys.argv[1])):
        stamp = genpy.Time(second + 1)
        for name, data in mix:
            kind = kinds[name]
            bag.write(name, (kind._type, data, kind._md5sum, kind), stamp, raw=True)
    bag.close()
    print((time.process_time() - begin) / (int(sys.argv[1]) * len(mix)) * 1000)
"""


def rosbag_cost(messages: Mix, folder: Path) -> float:
    """Write the same bytes with rosbag 1's Python writer, with default settings (no compression)."""
    files = {topic.name: folder / topic.group for topic in RATES}
    files = {name: path.with_name(name.replace("/", "-")) for name, path in files.items()}
    for topic, data in messages:
        files[topic.name].write_bytes(data)
    names = "\n".join(topic.name for topic, _ in messages)
    arguments = [f"{name}={path}" for name, path in files.items()]
    command = [str(SYSTEM_PYTHON), "-c", ROSBAG, str(SECONDS), *arguments]
    return float(subprocess.run(command, input=names, capture_output=True, text=True, check=True).stdout)


def has_rosbag() -> bool:
    """Whether the system's Python finds Debian's rosbag."""
    return can_import("rosbag", "sensor_msgs.msg", "geometry_msgs.msg")


def cost(rounds: int) -> dict[str, float]:
    """Return medians; the ratio is within one round."""
    messages, with_rosbag = mix(), has_rosbag()
    ours, theirs = np.empty(rounds), np.empty(rounds)
    with tempfile.TemporaryDirectory() as folder:
        for i in range(rounds):
            ours[i] = run_wall(lambda clock: recorder_cost(clock, messages))
            theirs[i] = rosbag_cost(messages, Path(folder)) if with_rosbag else np.nan
    figures = {"cpu_s_per_1000": float(np.median(ours))}
    if with_rosbag:
        figures |= {
            "rosbag_cpu_s_per_1000": float(np.median(theirs)),
            "cpu_over_rosbag": float(np.median(ours / theirs)),
        }
    return figures


# Stall


class TimedQueue(queue.SimpleQueue):
    """Records the processor time of its reader between two calls of ``get``."""

    def __init__(self) -> None:
        self.turns: list[float] = []
        self._begin: float | None = None

    def get(self, block: bool = True, timeout: float | None = None) -> Any:
        """Get an item as usual."""
        if self._begin is not None:
            self.turns.append(1e3 * (time.thread_time() - self._begin))
        try:
            return super().get(block, timeout)
        finally:
            self._begin = time.thread_time()


async def lateness(clock: WallClock, messages: Mix, *, recording: bool) -> tuple[np.ndarray, float]:
    """Return the lateness (ms) of a 1 ms ticker, with or without recording in real time; and the longest turn, ms."""
    late: list[float] = []
    work = TimedQueue()

    async def tick() -> None:
        while True:
            begin = clock.now()
            await clock.sleep(0.001)
            late.append((clock.now() - begin) / 1e6 - 1.0)

    with tempfile.TemporaryDirectory() as folder:
        recorder = Recorder(config(Path(folder)), clock, _no_failure)
        recorder._queue = work  # noqa: SLF001  # the one place where its thread waits
        async with recorder:
            await clock.sleep(0.5)
            work.turns.clear()
            ticking = asyncio.create_task(tick())
            due = clock.now()
            for _ in range(int(WATCHED)):
                for topic, data in messages:
                    due += SECOND // len(messages)
                    await clock.sleep_until(due)
                    if recording:
                        recorder.record(topic, due, data)
            ticking.cancel()
            return np.array(late), max(work.turns)


def stall(rounds: int) -> dict[str, float]:
    """Return the maximum lateness with recording, minus that without, as the median of the rounds."""
    messages = mix()
    greatest = np.empty((rounds, 2))
    p999 = np.empty((rounds, 2))
    turns = np.empty(rounds)
    for i in range(rounds):
        for column, recording in enumerate((False, True)):
            late, turns[i] = run_wall(lambda clock, on=recording: lateness(clock, messages, recording=on))
            greatest[i, column] = late.max()
            p999[i, column] = np.percentile(late, 99.9)
    without, with_it = np.median(greatest, axis=0)
    return {
        "ticker_max_ms": float(without),
        "ticker_max_recording_ms": float(with_it),
        "stall_ms": float(np.median(greatest[:, 1] - greatest[:, 0])),
        "longest_turn_ms": float(np.median(turns)),
        "stall_p999_ms": float(np.median(p999[:, 1] - p999[:, 0])),
    }


# Crash


async def record_for_ever(clock: WallClock, folder: Path) -> None:
    """Record until killed; print the file, and after every fsync its size on the disk."""
    messages = mix()
    sync = LogFile.sync

    def reported(file: LogFile) -> None:
        sync(file)
        print(f"synced {file.size}", flush=True)

    LogFile.sync = reported  # type: ignore[method-assign]
    async with Recorder(config(folder), clock, _no_failure) as recorder:
        while recorder.path is None:
            await clock.sleep(0.01)
        print(f"file {recorder.path}", flush=True)
        due = clock.now()
        while True:
            for topic, data in messages:
                due += SECOND // len(messages)
                await clock.sleep_until(due)
                recorder.record(topic, due, data)


def crashes(kills: int) -> dict[str, float]:
    """Kill ``kills`` recordings, four at a time, each after a different time of up to two periods of fsync."""
    rng = np.random.default_rng(1)
    lost, unreadable, lost_power = [], 0, []
    with tempfile.TemporaryDirectory() as folder:
        for first in range(0, kills, 4):
            folders = [Path(folder) / str(i) for i in range(first, min(first + 4, kills))]
            children = [_Child(each) for each in folders]
            begin = time.monotonic()
            for child, instant in zip(children, np.sort(rng.uniform(2.0, 11.0, len(children))), strict=True):
                time.sleep(max(0.0, begin + instant - time.monotonic()))
                child.kill()
            for child in children:
                try:
                    lost.append(child.lost(child.size()))
                    lost_power.append(child.lost(child.synced))
                except Exception as error:  # noqa: BLE001  # whatever it is, the file did not open
                    print(f"{child.path}: {error!r}")
                    unreadable += 1
    return {
        "kills": kills,
        "unreadable": unreadable,
        "median_loss_s": float(np.median(lost)),
        "worst_loss_s": max(lost),
        "median_power_cut_loss_s": float(np.median(lost_power)),
        "worst_power_cut_loss_s": max(lost_power),
    }


class _Child:
    """One recording process."""

    def __init__(self, folder: Path) -> None:
        command = [sys.executable, __file__, "--record", str(folder)]
        self._process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        assert self._process.stdout is not None
        self.path = Path(self._process.stdout.readline().removeprefix("file ").strip())
        self.began = time.monotonic_ns()
        self.killed = 0
        self.synced = 0
        """Bytes on the disk for certain when it was killed."""

    def kill(self) -> None:
        self.killed = time.monotonic_ns()
        self._process.send_signal(signal.SIGKILL)
        output, _ = self._process.communicate()
        sizes = [int(line.split()[1]) for line in output.splitlines()]
        self.synced = sizes[-1] if sizes else 0

    def size(self) -> int:
        return self.path.stat().st_size

    def lost(self, size: int) -> float:
        """Return the seconds before the kill that are missing in the repaired first ``size`` bytes of the file."""
        cut = self.path.with_name(f"cut-{size}.mcap")
        shutil.copy(self.path, cut)
        with cut.open("r+b") as file:
            file.truncate(size)
        if size == 0:
            return (self.killed - self.began) / SECOND
        recover(cut, cut)
        return (self.killed - max(self._times(cut), default=self.began)) / SECOND

    @staticmethod
    def _times(path: Path) -> Iterator[int]:
        return (message.log_time for message in open_log(path))


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--kills", type=int, default=20)
    parser.add_argument("--record", type=Path, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.record is not None:
        run_wall(lambda clock: record_for_ever(clock, arguments.record))
    if has_rosbag():
        go_on_in_the_systems_python()
    figures = cost(3 * arguments.rounds) | stall(arguments.rounds) | crashes(arguments.kills)
    for name, value in figures.items():
        print(f"{name:24} {value:9.4f}")
    goals = {name: goal for name, goal in GOALS.items() if name in figures}
    met = all(figures[name] <= goal for name, goal in goals.items())
    print(json.dumps({"bench": "recording", "figures": figures, "goals": goals, "met": met}))


if __name__ == "__main__":
    main()
