"""Start of a daemon: loads its configuration, with saved settings and calibration if their files are usable."""

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
    """A damaged or invalid file that the daemon ignores when it starts."""

    file: Path
    source: str
    """Service that uses its values."""
    text: str
    """Damage, and replacement values; after ``set_aside`` also the new name of the file."""


def started(config: T, tree: Tree) -> tuple[T, Tree, tuple[LeftOut, ...]]:
    """Return the configuration as ``calibrated`` does, without unusable saved settings and calibrations.

    Unusable saved settings are replaced by the configuration's settings, a damaged calibration by the previous one. The
    files keep their names until ``set_aside``.

    Raises:
        ConfigError: the calibration is for another truck, or its folder cannot be read.
    """
    left: dict[Path, LeftOut] = {}
    while True:
        try:
            return (*calibrated(config, tree, left), tuple(left.values()))
        except UnusableFileError as error:
            left[error.file] = _left_out(error, SavedSettings(config.state_directory, config.robot).path)


def _left_out(error: UnusableFileError, settings: Path) -> LeftOut:
    if error.file == settings:
        source, instead = ServiceName.GATE.value, "the values of the configuration are used"
    else:
        source, instead = ServiceName.CALIBRATION.value, "the previous calibration is used, if there is one"
    return LeftOut(error.file, source, f"{error}; {instead}")


async def set_aside(
    left_out: Iterable[LeftOut], store_stop: Callable[[], Awaitable[bool]], offload: Offload
) -> tuple[LeftOut, ...]:
    """Rename ignored files so that they are kept and do not block later saves; see ``put_aside``.

    The latched emergency stop is stored first: if this start crashed afterwards, the next start would otherwise begin
    without the stop.

    Args:
        left_out: ignored files.
        store_stop: stores the latched stop; returns False on failure.
        offload: runs the renaming of files.
    """
    files = tuple(left_out)
    if not files:
        return ()
    if not await store_stop():
        return tuple(one._replace(text=f"{one.text}; the file remains until the stop can be stored") for one in files)
    return tuple([one._replace(text=f"{one.text}; {await offload(partial(put_aside, one.file))}") for one in files])
