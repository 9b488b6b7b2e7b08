"""LeRobot data sets (version 3.0) from a log: one episode at a constant frame rate.

A frame holds the latest messages: odometry (pose and velocity) as ``observation.state``, the camera picture as
``observation.images.camera`` (H.264), and the gate's drive and steering commands as ``action``.
"""

import json
from collections.abc import Iterator, Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import Any, Final, Self

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet
from numpy.typing import NDArray

from monstertruck_runtime.clock import SECOND
from monstertruck_runtime.errors import InputError
from monstertruck_schemas import topics as t
from monstertruck_schemas.base import Message
from monstertruck_schemas.cmd import DriveCommand, SteeringCommand
from monstertruck_schemas.sensor import CompressedImage
from monstertruck_schemas.state import Odometry
from monstertruckd.recorder.reader import LogReader, open_log
from monstertruckd.tools.logs.export import removed_on_failure
from monstertruckd.tools.logs.messages import ALL, Progress, Selection
from monstertruckd.tools.logs.pixels import pixels_of
from monstertruckd.tools.logs.summary import info

FPS: Final = 10
"""Frames per second."""
STATE: Final = ("x", "y", "yaw", "vx", "vy", "wz")
"""``observation.state``: m, m, rad, m/s, m/s, rad/s."""
ACTIONS: Final = {t.CMD_DRIVE.name: ("speed",), t.CMD_STEERING.name: ("front", "rear")}
"""``action``: m/s, and axle angles in rad."""
CAMERA: Final = "observation.images.camera"
TASK: Final = "drive"
ROWS: Final = 1024
"""Number of frames in a row group."""
_FILE: Final = "chunk-000/file-000"
_INDICES: Final = ("frame_index", "episode_index", "index", "task_index")


class _Statistics:
    """Running minimum, maximum, mean and standard deviation of vectors, shape (n,)."""

    def __init__(self) -> None:
        self.count = 0
        self._sum = self._squares = np.zeros(0)
        self._least = self._greatest = np.zeros(0)

    def add(self, values: NDArray[Any]) -> None:
        rows = np.atleast_2d(np.asarray(values, np.float64))
        least, greatest = rows.min(0), rows.max(0)
        if not self.count:
            self._least, self._greatest = least, greatest
            self._sum = self._squares = np.zeros(rows.shape[1])
        self._least, self._greatest = np.minimum(self._least, least), np.maximum(self._greatest, greatest)
        self._sum, self._squares = self._sum + rows.sum(0), self._squares + (rows**2).sum(0)
        self.count += len(rows)

    def figures(self, frames: int, shape: tuple[int, ...]) -> dict[str, Any]:
        mean = self._sum / self.count
        deviation = np.sqrt(np.maximum(self._squares / self.count - mean**2, 0.0))
        figures = {"min": self._least, "max": self._greatest, "mean": mean, "std": deviation}
        return {**{name: value.reshape(shape).tolist() for name, value in figures.items()}, "count": [frames]}


def export_lerobot(
    path: str | Path | LogReader, output: str | Path, selection: Selection = ALL, progress: Progress | None = None
) -> dict[str, Path]:
    """Write a data set into a new folder.

    Returns:
        The folder by topic; empty, and no folder, if no frame has all topics.

    Raises:
        NotFoundError: no such log.
        InputError: not a log, no odometry or commands, topics selected, or the folder cannot be written.
    """
    if selection.topics:
        raise InputError("a data set needs fixed topics: omit the option --topic")
    reader = open_log(path)
    there = info(reader.path)["topics"]
    for topic in (t.ODOMETRY.name, t.CMD_DRIVE.name):
        if topic not in there:
            raise InputError(f"{reader.path}: no message of {topic}, which a data set needs")
    actions = {topic: names for topic, names in ACTIONS.items() if topic in there}
    topics = (t.ODOMETRY.name, *actions, *((t.CAMERA.name,) if t.CAMERA.name in there else ()))
    directory = Path(output)
    try:
        with removed_on_failure() as made:
            directory.mkdir(parents=True)
            made.append(directory)
            count = _write(reader, directory, Selection(topics, selection.start, selection.end), actions, progress)
            if not count:
                directory.rmdir()
                return {}
    except FileExistsError:
        raise InputError(f"{directory}: already exists") from None
    except OSError as error:
        raise InputError(f"{directory}: cannot be written: {error.strerror}") from error
    return dict.fromkeys(topics, directory)


def _write(
    reader: LogReader,
    directory: Path,
    selection: Selection,
    actions: Mapping[str, tuple[str, ...]],
    progress: Progress | None,
) -> int:
    """Write all files and return the number of frames."""
    names = tuple(name for row in actions.values() for name in row)
    statistics = {key: _Statistics() for key in ("observation.state", "action", "timestamp", *_INDICES)}
    schema = pa.schema(
        [
            ("observation.state", pa.list_(pa.float32(), len(STATE))),
            ("action", pa.list_(pa.float32(), len(names))),
            ("timestamp", pa.float32()),
            *((key, pa.int64()) for key in _INDICES),
        ]
    )
    count = 0
    video: _Video | None = None
    rows: dict[str, list[Any]] = {name: [] for name in schema.names}
    with ExitStack() as stack:
        writer: Any = None
        for count, newest in enumerate(_frames(reader, selection, progress), start=1):
            if writer is None:
                writer = stack.enter_context(
                    pyarrow.parquet.ParquetWriter(_made(directory / f"data/{_FILE}.parquet"), schema)
                )
            index = count - 1
            times = {"timestamp": index / FPS, "frame_index": index, "episode_index": 0, "index": index}
            row: dict[str, Any] = {
                "observation.state": _state(newest),
                "action": _action(newest),
                **times,
                "task_index": 0,
            }
            for name, value in row.items():
                rows[name].append(value)
                statistics[name].add(np.atleast_1d(value))
            if t.CAMERA.name in newest:
                if video is None:
                    video = stack.enter_context(_Video(_made(directory / f"videos/{CAMERA}/{_FILE}.mp4"), reader.path))
                video.add(newest[t.CAMERA.name])
            if len(rows["index"]) == ROWS:
                writer.write_table(pa.table(rows, schema))
                rows = {name: [] for name in schema.names}
        if writer is not None and rows["index"]:
            writer.write_table(pa.table(rows, schema))
    if count:
        figures = {key: row.figures(count, (-1,)) for key, row in statistics.items()}
        _write_meta(directory, count, reader, names, video, figures)
    return count


def _frames(reader: LogReader, selection: Selection, progress: Progress | None) -> Iterator[dict[str, Message]]:
    """Yield the latest message of each topic, frame by frame, once all topics have one."""
    newest: dict[str, Message] = {}
    due: int | None = None
    for entry, message in selection.of(reader, progress):
        while due is not None and entry.log_time > due:
            yield newest
            due += SECOND // FPS
        newest[entry.topic] = message
        if due is None and len(newest) == len(selection.topics):
            due = entry.log_time


def _state(newest: Mapping[str, Message]) -> list[float]:
    odometry = newest[t.ODOMETRY.name]
    assert isinstance(odometry, Odometry)
    pose, twist = odometry.pose, odometry.twist
    return [pose.x, pose.y, pose.yaw, twist.vx, twist.vy, twist.wz]


def _action(newest: Mapping[str, Message]) -> list[float]:
    drive, steering = newest[t.CMD_DRIVE.name], newest.get(t.CMD_STEERING.name)
    assert isinstance(drive, DriveCommand)
    axles = [steering.front, steering.rear] if isinstance(steering, SteeringCommand) else []
    return [drive.speed, *axles]


def _made(file: Path) -> Path:
    """Create the file's folder and return the file."""
    file.parent.mkdir(parents=True, exist_ok=True)
    return file


class _Video:
    """H.264 encoder for pictures of one size; a key frame every second picture lets readers seek to single frames."""

    def __init__(self, file: Path, log: Path) -> None:
        import av  # noqa: PLC0415 - only where there is a camera

        self._av = av
        self._log = log
        self._container = av.open(str(file), "w")
        self._stream: Any = None
        self.shape = (0, 0, 3)
        self.statistics = _Statistics()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        if self._stream is not None:
            self._container.mux(self._stream.encode())
        self._container.close()

    def add(self, message: Message) -> None:
        """Encode a picture without an odd last row or column, which the format cannot hold.

        Raises:
            InputError: the picture is damaged, too large, or differs in size from the first.
        """
        assert isinstance(message, CompressedImage)
        pixels = pixels_of(message.data, str(self._log))
        height, width = pixels.shape[0] // 2 * 2, pixels.shape[1] // 2 * 2
        pixels = np.ascontiguousarray(pixels[:height, :width])
        if self._stream is None:
            self._stream = self._container.add_stream("libx264", rate=FPS, options={"crf": "23", "bf": "0"})
            self._stream.width, self._stream.height, self._stream.pix_fmt = width, height, "yuv420p"
            self._stream.gop_size = 2
            self.shape = pixels.shape
        if pixels.shape != self.shape:
            raise InputError(f"{self._log}: pictures of {self.shape[:2]} and {pixels.shape[:2]} pixels in one video")
        self.statistics.add(pixels[::8, ::8].reshape(-1, 3) / 255)
        self._container.mux(self._stream.encode(self._av.VideoFrame.from_ndarray(pixels, format="rgb24")))


def _write_meta(
    directory: Path,
    count: int,
    reader: LogReader,
    names: tuple[str, ...],
    video: _Video | None,
    figures: dict[str, dict[str, Any]],
) -> None:
    """Write ``meta/``: information, tasks, statistics and the episode."""

    def vector(*axes: str) -> dict[str, Any]:
        return {"dtype": "float32", "shape": [len(axes)], "names": list(axes)}

    features: dict[str, Any] = {"observation.state": vector(*STATE), "action": vector(*names)}
    if video is not None:
        height, width, channels = video.shape
        facts = {"height": height, "width": width, "codec": "h264", "pix_fmt": "yuv420p", "is_depth_map": False}
        described = {f"video.{key}": value for key, value in (facts | {"fps": FPS, "channels": channels}).items()}
        shape, axes = [height, width, channels], ["height", "width", "channels"]
        features[CAMERA] = {"dtype": "video", "shape": shape, "names": axes, "info": described | {"has_audio": False}}
        figures = {**figures, CAMERA: video.statistics.figures(count, (3, 1, 1))}
    features["timestamp"] = {"dtype": "float32", "shape": [1], "names": None}
    features |= {key: {"dtype": "int64", "shape": [1], "names": None} for key in _INDICES}
    pattern = "chunk-{chunk_index:03d}/file-{file_index:03d}"
    information = {
        "codebase_version": "v3.0",
        "robot_type": reader.config().get("robot"),
        "total_episodes": 1,
        "total_frames": count,
        "total_tasks": 1,
        "chunks_size": 1000,
        "data_files_size_in_mb": 100,
        "video_files_size_in_mb": 200,
        "fps": FPS,
        "splits": {"train": "0:1"},
        "data_path": f"data/{pattern}.parquet",
        "video_path": None if video is None else f"videos/{{video_key}}/{pattern}.mp4",
        "features": features,
    }
    episode: dict[str, Any] = {
        "episode_index": 0,
        "tasks": [TASK],
        "length": count,
        "dataset_from_index": 0,
        "dataset_to_index": count,
        **dict.fromkeys(
            (f"{part}/{kind}_index" for part in ("data", "meta/episodes") for kind in ("chunk", "file")), 0
        ),
    }
    if video is not None:
        episode |= {f"videos/{CAMERA}/{kind}_index": 0 for kind in ("chunk", "file")}
        episode |= {f"videos/{CAMERA}/from_timestamp": 0.0, f"videos/{CAMERA}/to_timestamp": count / FPS}
    episode |= {f"stats/{key}/{name}": value for key, row in figures.items() for name, value in row.items()}
    _made(directory / "meta/info.json").write_text(json.dumps(information, indent=4))
    (directory / "meta/stats.json").write_text(json.dumps(figures, indent=4))
    pd.DataFrame({"task_index": [0]}, index=[TASK]).to_parquet(directory / "meta/tasks.parquet")
    rows = pa.table({name: [value] for name, value in episode.items()})
    pyarrow.parquet.write_table(rows, _made(directory / f"meta/episodes/{_FILE}.parquet"))
