"""Columns of a table of any length: values are collected in an unnamed file and become arrays chunk by chunk."""

import pickle
import zipfile
from array import array
from collections.abc import Callable, Iterable, Iterator
from itertools import chain
from typing import IO, Any, Final

import numpy as np
from numpy.typing import NDArray

from monstertruck_runtime.errors import InputError

KEPT_BYTES: Final = 16_000_000
"""Approximate limit of values in memory (bytes)."""


class Spool:
    """Storage for the values of many columns.

    Args:
        file: file open for reading and writing, inaccessible to others, because its content is trusted.
    """

    def __init__(self, file: IO[bytes]) -> None:
        self._file = file
        self._columns: list[Column] = []
        self._size = 0

    def column(self, text: Callable[[Any], str]) -> "Column":
        """Create a column; ``text`` converts values that are neither array nor number."""
        made = Column(self, text)
        self._columns.append(made)
        return made

    def grow(self, size: int) -> None:
        """Add to the bytes in memory; beyond ``KEPT_BYTES`` all columns are moved to the file."""
        self._size += size
        if self._size > KEPT_BYTES:
            for column in self._columns:
                column.flush()
            self._size = 0

    def write(self, values: list[Any]) -> int:
        """Write a chunk; return its offset."""
        place = self._file.seek(0, 2)
        pickle.dump(values, self._file, pickle.HIGHEST_PROTOCOL)
        return place

    def read(self, place: int) -> list[Any]:
        """Read a chunk."""
        self._file.seek(place)
        values: list[Any] = pickle.load(self._file)  # noqa: S301  # of this process alone
        return values


class Column:
    """Values of one column.

    Args:
        spool: storage of the values.
        text: converts values that are neither array nor number.
    """

    def __init__(self, spool: Spool, text: Callable[[Any], str]) -> None:
        self._spool = spool
        self._text = text
        self._places: list[int] = []
        self._waiting: list[Any] = []
        self._arrays = self._numbers = True
        self._gaps = False
        self._dtypes: set[np.dtype[Any]] = set()
        self._lengths = array("q")
        self._rest: tuple[int, ...] = ()
        self._count = 0

    def add(self, value: Any) -> None:
        """Add a value: an array, a number, None, or an object that ``text`` converts."""
        self._count += 1
        # Bytes of a value that is neither array nor text.
        size = 64
        if isinstance(value, np.ndarray):
            self._numbers = False
            self._dtypes.add(value.dtype)
            self._lengths.append(len(value))
            self._rest = value.shape[1:]
            size += value.nbytes
        else:
            self._arrays = False
            self._gaps |= value is None
            if not (value is None or isinstance(value, int | float)):
                self._numbers = False
                value = self._text(value)
                size += len(value)
        self._waiting.append(value)
        self._spool.grow(size)

    def flush(self) -> None:
        """Move pending values to the file."""
        if self._waiting:
            self._places.append(self._spool.write(self._waiting))
            self._waiting = []

    def _chunks(self) -> Iterator[list[Any]]:
        self.flush()
        return map(self._spool.read, self._places)

    def write(self, archive: zipfile.ZipFile, name: str) -> None:
        """Write the column as array ``name``; for arrays of different lengths also ``name.lengths``.

        Raises:
            InputError: a number has more than 64 bits.
        """
        if self._arrays:
            self._write_arrays(archive, name)
        elif self._numbers:
            self._write_numbers(archive, name)
        else:
            width = max(chain((1,), map(len, chain.from_iterable(self._texts()))))
            parts = (np.array(texts, f"<U{width}") for texts in self._texts())
            _write(archive, name, np.dtype(f"<U{width}"), (self._count,), parts)

    def _texts(self) -> Iterator[list[str]]:
        rows = 256  # number of texts per array: each is as wide as the longest one
        for values in self._chunks():
            for first in range(0, len(values), rows):
                yield [v if isinstance(v, str) else self._text(v) for v in values[first : first + rows]]

    def _write_arrays(self, archive: zipfile.ZipFile, name: str) -> None:
        dtype, lengths = np.result_type(*self._dtypes), np.array(self._lengths)
        equal = bool((lengths == lengths[0]).all())
        shape = (len(lengths), int(lengths[0])) if equal else (int(lengths.sum()),)
        parts = (np.concatenate(values).astype(dtype, copy=False) for values in self._chunks())
        _write(archive, name, dtype, (*shape, *self._rest), parts)
        if not equal:
            _write(archive, f"{name}.lengths", lengths.dtype, lengths.shape, (lengths,))

    def _write_numbers(self, archive: zipfile.ZipFile, name: str) -> None:
        if self._gaps:
            dtype = np.dtype(np.float64)
        else:
            dtype = np.result_type(*(np.array(values).dtype for values in self._chunks()))
        parts = (np.array([np.nan if v is None else v for v in values]).astype(dtype) for values in self._chunks())
        _write(archive, name, dtype, (self._count,), parts)


def _write(
    archive: zipfile.ZipFile,
    name: str,
    dtype: np.dtype[Any],
    shape: tuple[int, ...],
    parts: Iterable[NDArray[Any]],
) -> None:
    """Write an array for ``numpy.load``, part by part.

    numpy's own function needs the whole array at once, and rejects the name ``file``, which journal records use.
    """
    if dtype.hasobject:
        raise InputError(f"{name}: expected numbers of at most 64 bits")
    head = {"descr": np.lib.format.dtype_to_descr(dtype), "fortran_order": False, "shape": shape}
    with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
        np.lib.format.write_array_header_1_0(member, head)
        for part in parts:
            member.write(np.ascontiguousarray(part).tobytes())
