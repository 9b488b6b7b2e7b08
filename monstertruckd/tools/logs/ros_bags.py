"""Bags of ROS 1 and 2, read with the package ``rosbags`` of the extra ``logs``."""

import bz2
import sqlite3
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any, Final

import lz4.frame
from rosbags.rosbag1 import Reader as Ros1Reader
from rosbags.rosbag1 import ReaderError
from rosbags.rosbag2 import Reader as Ros2Reader

from monstertruck_runtime.errors import InputError
from monstertruck_runtime.outside import MOST_UNPACKED, reading
from monstertruck_runtime.small_files import MEGABYTE
from monstertruck_runtime.yaml_files import read_yaml
from monstertruckd.recorder.reader import open_log
from monstertruckd.tools.logs.bags import METADATA, READERS, RawMessage, mcap_messages


def _bounded(decompressor: Any) -> Callable[[bytes], bytes]:
    """Return a function that decompresses a chunk of at most ``MOST_UNPACKED`` bytes with a new ``decompressor``."""

    def unpack(data: bytes) -> bytes:
        unpacking = decompressor()
        found: bytes = unpacking.decompress(data, MOST_UNPACKED + 1)
        if not unpacking.eof:
            text = f"more than {MOST_UNPACKED // MEGABYTE} MB" if len(found) > MOST_UNPACKED else "cut off"
            raise ValueError(f"a compressed chunk is {text}")
        return found

    return unpack


BOUNDED: Final[dict[Any, Callable[[bytes], bytes]]] = {
    bz2.decompress: _bounded(bz2.BZ2Decompressor),
    lz4.frame.decompress: _bounded(lz4.frame.LZ4FrameDecompressor),
}
"""Bounded decompressors of ROS 1 chunks, by the unbounded function."""


def ros_messages(path: Path, version: int) -> Iterator[RawMessage]:
    """Yield the messages of a bag of ROS 1 (file) or 2 (folder, or one database of it).

    Topics with other message types are yielded once, without data.

    Raises:
        InputError: the bag cannot be read, is damaged, or contains compressed messages or chunks that are too large.
    """
    with reading(path, f"a bag of ROS {version}"):
        if path.is_dir() and (parts := _mcap_parts(path)) is not None:
            for part in parts:
                log = open_log(part)
                yield from mcap_messages(log.records())
                if log.fault is not None:
                    raise InputError(f"{part}: {log.fault}")
            return
        if version == 2:
            for database in sorted(path.glob("*.db3")) if path.is_dir() else [path]:
                _require_stored(database)
        encoding = "ros1" if version == 1 else "cdr"
        with _indexed(path) if version == 1 else Ros2Reader(path) as bag:
            if isinstance(bag, Ros1Reader):
                for at, chunk in bag.chunks.items():
                    unpack = BOUNDED.get(chunk.decompressor, chunk.decompressor)
                    bag.chunks[at] = chunk._replace(decompressor=unpack)
            read = [one for one in bag.connections if one.msgtype in READERS]
            for one in bag.connections:
                if one not in read:
                    yield RawMessage(one.topic, one.msgtype, encoding, 0, b"")
            if read:
                for one, time, data in bag.messages(connections=read):
                    yield RawMessage(one.topic, one.msgtype, encoding, time, bytes(data))


@contextmanager
def _indexed(path: Path) -> Iterator[Ros1Reader]:
    """Open a bag of ROS 1.

    Raises:
        InputError: it has no index, because its recording was cut off.
        ReaderError: it is no bag.
    """
    try:
        bag = Ros1Reader(path)
        bag.open()
    except ReaderError as error:
        if "index" not in str(error):
            raise
        raise InputError(f"{path}: expected a bag with an index: {error}: `rosbag reindex {path}` makes one") from error
    try:
        yield bag
    finally:
        bag.close()


def _require_stored(database: Path) -> None:
    """Check that the database returns only stored data.

    Raises:
        InputError: it computes rows or columns on reading, or repeats a topic id.
        sqlite3.DatabaseError: it is damaged, e.g. pages are referenced more than once.
    """
    with closing(sqlite3.connect(f"{database.absolute().as_uri()}?mode=ro", uri=True)) as bag:
        for kind, name, declared in bag.execute("SELECT type, name, sql FROM sqlite_master").fetchall():
            if kind == "view" or (kind == "table" and str(declared).upper().startswith("CREATE VIRTUAL")):
                raise InputError(f"{database}: {name} is a view or virtual table: expected stored tables only")
            if kind == "table" and any(row[-1] for row in bag.execute("SELECT * FROM pragma_table_xinfo(?)", (name,))):
                raise InputError(f"{database}: table {name} has computed columns: expected stored ones")
        ((fault,),) = bag.execute("PRAGMA quick_check(1)").fetchall()
        if fault != "ok":
            raise sqlite3.DatabaseError(str(fault).removeprefix("*** in database main ***").strip())
        repeated = bag.execute("SELECT id FROM topics GROUP BY id HAVING count(*) > 1").fetchone()
        if repeated is not None:
            raise InputError(f"{database}: several topics have the id {repeated[0]}: expected unique ids")


def _mcap_parts(folder: Path) -> list[Path] | None:
    """Return the files of a ROS 2 bag stored as MCAP; None for another storage.

    Raises:
        InputError: its metadata cannot be read, or the bag is compressed.
    """
    about = read_yaml(folder / METADATA)["rosbag2_bagfile_information"]
    packed = str(about.get("compression_mode") or "none").lower()
    if packed != "none":
        raise InputError(
            f"{folder}: compressed with {packed} (compression_mode): decompress it first with `ros2 bag convert`"
        )
    if about["storage_identifier"] != "mcap":
        return None
    return [folder / Path(name).name for name in about["relative_file_paths"]]
