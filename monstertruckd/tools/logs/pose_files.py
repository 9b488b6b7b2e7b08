"""Poses of a log in the text formats of the TUM and KITTI benchmarks, one file per topic."""

from contextlib import ExitStack
from pathlib import Path

from monstertruck_runtime.clock import SECOND
from monstertruck_runtime.errors import InputError
from monstertruck_schemas.state import Odometry
from monstertruck_schemas.topics import BY_NAME
from monstertruckd.recorder.reader import LogReader, open_log
from monstertruckd.tools.logs.export import made_folder, whole_tables
from monstertruckd.tools.logs.messages import ALL, Progress, Selection, real_offset
from monstertruckd.tools.logs.trajectory import Line, kitti, tum


def export_tum(
    path: str | Path | LogReader, output: str | Path, selection: Selection = ALL, progress: Progress | None = None
) -> dict[str, Path]:
    """Write ``<group>_<name>.tum`` for every topic of poses: ``t x y z qx qy qz qw``, UNIX time in s, metres.

    Returns:
        The files by topic.

    Raises:
        NotFoundError: no such log.
        InputError: not a log, a selected topic has no poses, a message is invalid, or the folder cannot be written.
    """
    return _export(path, output, selection, progress, ".tum", tum)


def export_kitti(
    path: str | Path | LogReader, output: str | Path, selection: Selection = ALL, progress: Progress | None = None
) -> dict[str, Path]:
    """Write ``<group>_<name>.kitti`` for every topic of poses: the 3 x 4 matrix of base in its frame, row by row.

    Returns and raises the same as ``export_tum``.
    """
    return _export(path, output, selection, progress, ".kitti", kitti)


def _export(
    path: str | Path | LogReader,
    output: str | Path,
    selection: Selection,
    progress: Progress | None,
    suffix: str,
    line: Line,
) -> dict[str, Path]:
    with_poses = tuple(name for name, topic in BY_NAME.items() if topic.model is Odometry)
    for topic in selection.topics:
        if topic not in with_poses:
            raise InputError(f"{topic} has no poses: expected some of {', '.join(with_poses)}")
    chosen = Selection(selection.topics or with_poses, selection.start, selection.end)
    reader = open_log(path)
    offset = real_offset(reader)
    directory = made_folder(output)
    files: dict[str, Path] = {}
    with whole_tables(directory, suffix, files) as place, ExitStack() as stack:
        streams = {}
        for entry, message in chosen.of(reader, progress):
            assert isinstance(message, Odometry)
            if entry.topic not in streams:
                streams[entry.topic] = stack.enter_context(place(entry.topic).open("w"))
            pose = message.pose
            streams[entry.topic].write(line((message.stamp + offset) / SECOND, pose.x, pose.y, pose.yaw))
    return files
