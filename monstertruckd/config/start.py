"""What a daemon starts with: its configuration and whatever is sound of the files that it wrote itself."""

from pathlib import Path
from typing import NamedTuple, TypeVar

from monstertruck_runtime.errors import UnusableFileError
from monstertruck_runtime.small_files import put_aside
from monstertruck_schemas.roles import ServiceName
from monstertruckd.config.load import SavedSettings, Tree, calibrated
from monstertruckd.config.truck import TruckConfig

T = TypeVar("T", bound=TruckConfig)


class LeftOut(NamedTuple):
    """A file that a start goes on without."""

    source: str
    """Service whose values they are."""
    text: str
    """What is wrong with the file, what counts instead, and where it is kept."""


def started(config: T, tree: Tree) -> tuple[T, Tree, tuple[LeftOut, ...]]:
    """Return the configuration as ``calibrated`` does, without saved settings and calibrations that cannot be used.

    Such a file is renamed (see ``put_aside``), so that it is kept and later saves do not fail by it. Instead of saved
    settings those of the configuration count, instead of a calibration the one before it.

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
    return LeftOut(source, f"{error}; {instead}; {put_aside(error.file)}")
