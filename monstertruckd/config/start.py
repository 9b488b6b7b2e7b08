"""Start of a daemon: its configuration, with saved settings and calibration as far as their files are usable."""

from collections.abc import Awaitable, Callable, Iterable
from functools import partial
from pathlib import Path
from typing import NamedTuple, TypeVar

from monstertruck_runtime.errors import UnusableFileError
from monstertruck_runtime.small_files import put_aside
from monstertruck_runtime.threads import Offload
from monstertruck_schemas.roles import ServiceName
from monstertruckd.config.load import SavedSettings, Tree, calibrated
from monstertruckd.config.truck import TruckConfig

T = TypeVar("T", bound=TruckConfig)


class LeftOut(NamedTuple):
    """An unusable file that the daemon starts without."""

    file: Path
    source: str
    """Service whose values they are."""
    text: str
    """Damage and replacement of the file; after ``set_aside`` also the name under which it is kept."""


def started(config: T, tree: Tree) -> tuple[T, Tree, tuple[LeftOut, ...]]:
    """Return the configuration as ``calibrated`` does, without saved settings and calibrations that cannot be used.

    The configuration's settings replace saved ones, and the previous calibration replaces a damaged one. The files
    keep their names until ``set_aside``.

    Raises:
        ConfigError: the calibration is of another truck, or its folder cannot be read.
    """
    left: dict[Path, LeftOut] = {}
    while True:
        try:
            return (*calibrated(config, tree, left), tuple(left.values()))
        except UnusableFileError as error:
            left[error.file] = _left_out(error, SavedSettings(config.state_directory, config.robot).path)


def _left_out(error: UnusableFileError, settings: Path) -> LeftOut:
    if error.file == settings:
        source, instead = ServiceName.GATE.value, "the settings of the configuration count"
    else:
        source, instead = ServiceName.CALIBRATION.value, "the calibration before it counts, if there is one"
    return LeftOut(error.file, source, f"{error}; {instead}")


async def set_aside(
    left_out: Iterable[LeftOut], store_stop: Callable[[], Awaitable[bool]], offload: Offload
) -> tuple[LeftOut, ...]:
    """Rename files that are left out, so that they are kept and later saves do not fail by them; see ``put_aside``.

    The latched emergency stop is stored first: otherwise a start that dies here is followed by one that does not stop.

    Args:
        left_out: the files.
        store_stop: stores the latched stop; False if it could not.
        offload: where files are renamed.
    """
    files = tuple(left_out)
    if not files:
        return ()
    if not await store_stop():
        return tuple(one._replace(text=f"{one.text}; the file stays until the stop can be stored") for one in files)
    return tuple([one._replace(text=f"{one.text}; {await offload(partial(put_aside, one.file))}") for one in files])
