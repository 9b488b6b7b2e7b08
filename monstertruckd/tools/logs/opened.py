"""Log access for notebooks: topics as NumPy arrays, pandas or polars tables, pictures, maps and events.

Every call reads the file once and keeps only the selected data in memory. For long logs, select columns, or iterate
with ``batches`` or ``frames``.
"""

import warnings
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from monstertruck_runtime.clock import SECOND
from monstertruck_runtime.errors import InputError, NotFoundError
from monstertruck_schemas import topics as t
from monstertruck_schemas.base import Message
from monstertruck_schemas.state import Grid
from monstertruck_schemas.topics import BY_NAME
from monstertruckd.recorder.reader import LogReader
from monstertruckd.tools.logs import arrow
from monstertruckd.tools.logs.export import LOG_TIME
from monstertruckd.tools.logs.messages import Selection, require_topics
from monstertruckd.tools.logs.pixels import pixels_of
from monstertruckd.tools.logs.summary import info

TIME: Final = "time"
"""Column of seconds since the log's first message."""
STAMP: Final = "stamp"

Library = Literal["pandas", "polars"]


class OpenedLog:
    """A log opened for analysis, finished or not; damage causes a warning, and the intact parts are read.

    Topics may be given in full (``state/odometry``) or by their last part (``odometry``) if it is unique outside
    ``health/``. ``start`` and ``end`` of its methods are seconds after the log's first message.

    Args:
        path: an MCAP file of this program.

    Raises:
        NotFoundError: no such file.
        InputError: not an MCAP file.
    """

    def __init__(self, path: str | Path) -> None:
        self._reader = LogReader(Path(path))

    def __repr__(self) -> str:
        return f"<log {self._reader.path}>"

    def topics(self) -> dict[str, int]:
        """Return the number of messages by topic; only ``map build`` reads topics of other programs."""
        found = info(self._reader.path)
        self._warn(found["damage"])
        return {name: row["messages"] for name, row in found["topics"].items()}

    def config(self) -> dict[str, Any]:
        """Recorded configuration of the robot; empty if there is none."""
        return self._reader.config()

    def messages(self, topic: str, start: float = 0.0, end: float = np.inf) -> Iterator[tuple[float, Message]]:
        """Yield time (s) and message of a topic."""
        first = self._first()
        for entry, message in Selection((self._named(topic),), start, end).of(self._reader):
            yield (entry.log_time - first) / SECOND, message
        self._warn()

    def batches(
        self, topic: str, columns: Sequence[str] = (), start: float = 0.0, end: float = np.inf
    ) -> Iterator[pa.RecordBatch]:
        """Yield a topic's rows as Arrow batches of a few MB, so that a log of any length needs little memory."""
        for _, batch in arrow.batches(self._reader, Selection((self._named(topic),), start, end), columns):
            yield batch
        self._warn()

    def table(self, topic: str, columns: Sequence[str] = (), start: float = 0.0, end: float = np.inf) -> pa.Table:
        """Return a topic as an Arrow table whose first column is ``time`` (s since the log's first message).

        Raises:
            NotFoundError: no such topic or column.
            InputError: a message is invalid.
        """
        return self._table(self._named(topic), columns, start, end)

    def numpy(
        self, topic: str, columns: Sequence[str] = (), start: float = 0.0, end: float = np.inf
    ) -> dict[str, NDArray[Any]]:
        """Return a topic as one array per column, shape (messages,) or (messages, length); absent numbers are NaN.

        Arrays of different lengths become an object array of arrays.
        """
        table = self.table(topic, columns, start, end)
        return {name: _as_numpy(table[name].combine_chunks()) for name in table.column_names}

    def pandas(self, topic: str, columns: Sequence[str] = (), start: float = 0.0, end: float = np.inf) -> Any:
        """Return a topic as a ``pandas.DataFrame`` with ``time`` (s since the log's first message) as its index."""
        return _as_frame(self.table(topic, columns, start, end), "pandas")

    def polars(self, topic: str, columns: Sequence[str] = (), start: float = 0.0, end: float = np.inf) -> Any:
        """Return a topic as a ``polars.DataFrame``."""
        return _as_frame(self.table(topic, columns, start, end), "polars")

    def frame(
        self,
        *topics: str,
        at: str | None = None,
        within: float = np.inf,
        columns: Sequence[str] = (),
        start: float = 0.0,
        end: float = np.inf,
        library: Library = "pandas",
    ) -> Any:
        """Join several topics in one table: a row per message of ``at``, with the nearest messages by stamp.

        Column names start with the topic as given here: ``odometry.pose.x``.

        Args:
            topics: topic names.
            at: topic whose messages define the rows; by default the first.
            within: maximum difference of two stamps (s); without a message within it, the topic's cells are empty.
            columns: column names in the topics' tables; empty: all.
            start: start time after the log's first message (s).
            end: end time after the log's first message (s).
            library: library of the returned table.

        Raises:
            InputError: no topic, or ``at`` is not among them.
            NotFoundError: no such topic, or none of the topics has a column.
        """
        parts = self._aligned(topics, at, within, columns, Selection((), start, end), np.inf)
        return _as_frame(pa.concat_tables(parts), library)

    def frames(
        self,
        *topics: str,
        at: str | None = None,
        within: float = np.inf,
        columns: Sequence[str] = (),
        start: float = 0.0,
        end: float = np.inf,
        library: Library = "pandas",
        seconds: float = 60.0,
    ) -> Iterator[Any]:
        """Yield the table of ``frame`` in parts of about ``seconds`` of the log, in bounded memory.

        A row waits at most ``seconds`` for a later message of each topic.
        """
        for table in self._aligned(topics, at, within, columns, Selection((), start, end), seconds):
            if len(table):
                yield _as_frame(table, library)

    def _aligned(
        self,
        topics: Sequence[str],
        at: str | None,
        within: float,
        columns: Sequence[str],
        times: Selection,
        seconds: float,
    ) -> Iterator[pa.Table]:
        """Yield the tables of ``frame``, one for each window of ``seconds``."""
        at = topics[0] if at is None and topics else at
        if at is None or at not in topics:
            raise InputError(f"at {at!r}: expected one of the topics of the table ({', '.join(topics) or 'none'})")
        known = {topic: arrow.schema_of(self._named(topic)).names for topic in topics}
        for column in columns:
            if not any(column in names for names in known.values()):
                raise NotFoundError(f"no column {column} in {', '.join(topics)}")
        wanted = {self._named(topic): _wanted(names, columns) for topic, names in known.items()}
        selection, first = Selection(tuple(wanted), times.start, times.end), self._first()

        def beside(rows: pa.Table, tables: Mapping[str, pa.Table]) -> pa.Table:
            """Match the rows of the other topics to the rows of ``at``."""
            stamps = rows[STAMP].to_numpy()
            parts = {TIME: pa.array((rows[LOG_TIME].to_numpy() - first) / SECOND)}
            for topic, table in tables.items():
                near = rows if topic == at else table.take(_nearest(table[STAMP].to_numpy(), stamps, within))
                named_so = (name for name in near.column_names if not columns or name in columns)
                parts |= {f"{topic}.{name}": near[name] for name in named_so}
            return pa.table(parts)

        kept: dict[str, pa.Table] = {}
        for rows in arrow.windows(self._reader, selection, wanted, seconds):
            tables = {
                topic: pa.concat_tables([kept[topic], rows[self._named(topic)]]) if kept else rows[self._named(topic)]
                for topic in topics
            }
            ready = _ready(tables, at, seconds)
            yield beside(tables[at].filter(ready), tables)
            kept = _rest(tables, at, ready, seconds)
        yield beside(kept[at], kept)
        self._warn()

    def images(
        self, topic: str = t.CAMERA.name, start: float = 0.0, end: float = np.inf
    ) -> Iterator[tuple[float, NDArray[np.uint8]]]:
        """Yield time (s) and picture, shape (height, width, 3), RGB.

        Raises:
            InputError: a picture is damaged or has too many pixels.
        """
        for time, message in self.messages(topic, start, end):
            where = f"{self._reader.path}: {topic} at {time:.3f} s"
            if not isinstance(data := getattr(message, "data", None), bytes):
                raise InputError(f"{topic} has no pictures")
            yield time, pixels_of(data, where)

    def maps(self, start: float = 0.0, end: float = np.inf) -> Iterator[tuple[float, Grid, NDArray[np.int8]]]:
        """Yield time (s), map and its cells, shape (height, width), row 0 at the lowest y."""
        for time, message in self.messages(t.MAP.name, start, end):
            if isinstance(message, Grid):
                yield time, message, message.cells.reshape(message.height, message.width)

    def events(self, start: float = 0.0, end: float = np.inf) -> Any:
        """Return decisions, faults and recoveries as a ``pandas.DataFrame``."""
        return self.pandas(t.EVENT.name, start=start, end=end)

    def _first(self) -> int:
        """Return the daemon time of the first message (ns); 0 for an empty log."""
        return next((entry.log_time for entry in self._reader), 0)

    def _table(self, topic: str, columns: Sequence[str], start: float, end: float) -> pa.Table:
        wanted = [LOG_TIME, *columns] if columns else ()
        found = [batch for _, batch in arrow.batches(self._reader, Selection((topic,), start, end), wanted)]
        self._warn()
        schema = pa.schema([field for field in arrow.schema_of(topic) if not wanted or field.name in wanted])
        table = pa.Table.from_batches(found, schema)
        time = (table[LOG_TIME].to_numpy() - self._first()) / SECOND
        if columns and LOG_TIME not in columns:
            table = table.drop_columns(LOG_TIME)
        return table.add_column(0, TIME, pa.array(time))

    def _named(self, topic: str) -> str:
        """A topic's full name.

        Raises:
            NotFoundError: no topic, or several topics, have it, or its messages are of another program's type.
        """
        try:
            return named(topic)
        except NotFoundError:
            row = info(self._reader.path)["topics"].get(topic)
            if row is None:
                raise
        raise NotFoundError(f"{self._reader.path}: {topic} contains {row['schema']}: expected a topic of monstertruckd")

    def _warn(self, fault: str | None = None) -> None:
        fault = fault or self._reader.fault
        if fault is not None:
            warnings.warn(f"{self._reader.path}: {fault}; only the intact part was read", stacklevel=3)


def named(topic: str) -> str:
    """Return a topic's full name, given the full name or its last part.

    Raises:
        NotFoundError: no topic, or more than one, has this name.
    """
    if topic in BY_NAME:
        return topic
    found = [name for name in BY_NAME if name.rpartition("/")[2] == topic]
    # A service, a request and an output may share a name: the output is used.
    found = [name for name in found if not name.startswith(("health/", "req/"))] or found
    if len(found) > 1:
        raise NotFoundError(f"topic {topic}: expected one of {', '.join(found)}")
    if not found:
        require_topics(topic)
    return found[0]


def _wanted(names: Sequence[str], columns: Sequence[str]) -> list[str]:
    """Return the columns of a topic that a table needs; empty: all."""
    times = (LOG_TIME, STAMP)
    return [*times, *(name for name in names if name in columns and name not in times)] if columns else []


def _ready(tables: Mapping[str, pa.Table], at: str, seconds: float) -> pa.Array:
    """Return which rows of ``at`` have a later row of every other topic, or have waited for ``seconds`` of the log."""
    rows = tables[at]
    newest = min((_greatest(table[STAMP]) for topic, table in tables.items() if topic != at), default=np.inf)
    waited = max(_greatest(table[LOG_TIME]) for table in tables.values()) - seconds * SECOND
    return pa.array((rows[STAMP].to_numpy() <= newest) | (rows[LOG_TIME].to_numpy() < waited))


def _rest(tables: Mapping[str, pa.Table], at: str, ready: pa.Array, seconds: float) -> dict[str, pa.Table]:
    """Return the waiting rows of ``at``, and the rows of other topics that may be nearest to them or to later ones."""
    waiting = tables[at].filter(pc.invert(ready))
    since = max(_greatest(table[STAMP]) for table in tables.values()) - seconds * SECOND
    if len(waiting):
        since = min(since, pc.min(waiting[STAMP]).as_py())

    def near(table: pa.Table) -> pa.Table:
        stamps = table[STAMP].to_numpy()
        return table.filter(pa.array(stamps >= _greatest(stamps[stamps <= since])))

    return {topic: waiting if topic == at else near(table) for topic, table in tables.items()}


def _greatest(values: Any) -> float:
    """Return the maximum of integers, or minus infinity if there are none."""
    return np.asarray(values).max() if len(values) else -np.inf


def _nearest(stamps: NDArray[np.int64], at: NDArray[np.int64], within: float) -> pa.Array:
    """Return for each time the index of the nearest stamp; null if none is within ``within`` seconds.

    Args:
        stamps: shape (n,), ns, in any order.
        at: times, shape (m,) (ns).
        within: maximum difference (s).
    """
    if not len(stamps):
        return pa.nulls(len(at), pa.int64())
    order = np.argsort(stamps, kind="stable")
    rising = stamps[order]
    after = np.searchsorted(rising, at).clip(1, max(len(rising) - 1, 1)) if len(rising) > 1 else np.zeros(len(at), int)
    before = np.maximum(after - 1, 0)
    index = np.where(at - rising[before] <= rising[after] - at, before, after)
    return pa.array(order[index], mask=np.abs(rising[index] - at) > within * SECOND)


def _as_frame(table: pa.Table, library: Library) -> Any:
    if library == "polars":
        import polars as pl  # noqa: PLC0415 - only for its tables

        return pl.from_arrow(table)
    return table.to_pandas().set_index(TIME)


def _as_numpy(column: pa.Array) -> NDArray[Any]:
    if not pa.types.is_list(column.type):
        return np.asarray(column.to_numpy(zero_copy_only=False))
    lengths = np.diff(column.offsets.to_numpy())
    if not column.null_count and len(lengths) and (lengths == lengths[0]).all():
        flat = column.flatten()
        if pa.types.is_primitive(flat.type) and not flat.null_count:
            return np.asarray(flat.to_numpy(zero_copy_only=False)).reshape(len(lengths), int(lengths[0]))
    rows = np.empty(len(column), object)
    rows[:] = column.to_numpy(zero_copy_only=False)
    return rows
