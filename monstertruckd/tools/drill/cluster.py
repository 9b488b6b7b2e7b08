"""Computes on the workers of a dask cluster, see docs/safety.md."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Final, TypeVar

from monstertruck_runtime.errors import InputError, NoAnswerError, WorkerError

T = TypeVar("T")
U = TypeVar("U")

CONNECT: Final = 10.0
"""Seconds in which the scheduler must answer."""


@contextmanager
def on_cluster(address: str, step: Callable[[T], U], inputs: Sequence[T]) -> Iterator[Iterator[U]]:
    """Results of ``step`` in the order of ``inputs``; those of a worker that dies are computed by another one.

    Args:
        address: of the scheduler, ``tcp://HOST:PORT``.
        step: importable on the workers.
        inputs: one each.

    Raises:
        InputError: dask.distributed is not installed.
        NoAnswerError: no scheduler answers.
        WorkerError: workers died of one input three times in a row.
        Exception: what ``step`` raised.
    """
    try:
        from distributed import Client, KilledWorker  # noqa: PLC0415  # an extra
    except ImportError as error:
        raise InputError("--cluster needs dask.distributed: install monstertruckd[cluster]") from error
    try:
        client = Client(address, timeout=CONNECT)  # type: ignore[no-untyped-call]
    except (OSError, ValueError) as error:
        raise NoAnswerError(f"{address}: no dask scheduler answers: {error}") from error
    with client:
        futures = client.map(step, inputs, pure=False)

        def results() -> Iterator[U]:
            try:
                for future in futures:
                    yield future.result()
            except KilledWorker as error:
                raise WorkerError(f"{address}: {error}") from error

        yield results()
