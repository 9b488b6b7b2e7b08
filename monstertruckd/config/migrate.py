"""Brings configuration files of older versions up to the present one, step by step, keeping their comments.

A file without a ``version`` of its own has that of the file that includes it. The previous file is kept next to the new
one as ``NAME.vN``. A file that includes others is written last: an upgrade that is interrupted can simply be repeated,
because a step does nothing to a key that is already as it should be.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from ruamel.yaml.nodes import Node, ScalarNode, SequenceNode

from monstertruck_runtime.errors import ConfigError, InputError
from monstertruck_runtime.small_files import replace_file
from monstertruckd.config.edit import YamlText

Step = Callable[[YamlText], None]
"""Edits one file from its version to the next; must do nothing to what is already so."""

RENAMED: Final = (
    (("gate", "obstacle", "beside"), "side_clearance"),
    (("odometry", "compass", "patience"), "steady_time"),
    (("placement", "deformer"), "local_planner"),
    (("planner", "deform"), "local_planner"),
    (("planner", "ladder"), "recovery"),
    (("planner", "local", "beside"), "rejoin_distance"),
    (("planner", "local", "patience"), "blocked_timeout"),
    (("planner", "local", "rejoin"), "rejoin_clearance"),
    (("planner", "route", "greed"), "heuristic_weight"),
    (("planner", "sightings"), "blocked_scans"),
    (("slam", "mapper", "thinning"), "pruning"),
    (("tracker", "turn_within"), "steering_distance"),
    (("usb", "patience"), "empty_timeout"),
)
"""Keys of version 1, as of release 0.1.0, and what version 2 calls their last part."""


def _rename_keys(text: YamlText) -> None:
    for key, name in RENAMED:
        text.rename(key, name)


VERSION: Final = 2
"""Of the configuration files that this program writes."""
STEPS: Final[dict[int, Step]] = {1: _rename_keys}
"""By the version they start from."""
OLDEST: Final = min(STEPS)


@dataclass(frozen=True, slots=True)
class Upgrade:
    """What is to be done to one file."""

    path: Path
    version: int
    """It has now."""
    before: str
    after: str

    @property
    def kept(self) -> Path:
        """Where the previous file goes."""
        return self.path.with_name(f"{self.path.name}.v{self.version}")


def plan(path: Path, steps: Mapping[int, Step] = STEPS, target: int = VERSION) -> list[Upgrade]:
    """Upgrades of ``path`` and of all it includes, in the order in which they are to be written.

    Args:
        path: configuration file.
        steps: the chain.
        target: version to reach.

    Raises:
        ConfigError: a file is missing, is no YAML mapping, has no version or one this program does not know.
    """
    upgrades: dict[Path, Upgrade] = {}
    _visit(path, None, steps, target, upgrades, ())
    return [upgrade for upgrade in upgrades.values() if upgrade.after != upgrade.before]


def _visit(
    path: Path,
    inherited: int | None,
    steps: Mapping[int, Step],
    target: int,
    upgrades: dict[Path, Upgrade],
    including: tuple[Path, ...],
) -> None:
    place = path.resolve()
    if place in including:
        raise ConfigError(f"{path}: includes itself through {' > '.join(map(str, including))}")
    if place in upgrades:
        return
    text = YamlText.read(path)
    before, version = text.text, _version(text, inherited, target)
    for name in _includes(text):
        _visit(path.parent / name, version, steps, target, upgrades, (*including, place))
    _upgrade(text, version, steps, target)
    upgrades[place] = Upgrade(path, version, before, text.text)


def _upgrade(text: YamlText, version: int, steps: Mapping[int, Step], target: int) -> None:
    for number in range(version, target):
        if number not in steps:
            raise ConfigError(f"{text.path}: no way from version {number} to {number + 1}")
        steps[number](text)
        text.replace(("version",), str(number + 1))


def bring_up_to_date(text: YamlText, inherited: int | None) -> int | None:
    """Give the keys of a file of an older version their present names, in memory only.

    Args:
        text: content of the file.
        inherited: version of the file that includes it.

    Returns:
        The version it had; None if that is missing or not known, and nothing was done.
    """
    said = text.value("version")
    version = inherited if text.node("version") is None else int(said) if said and said.isdecimal() else None
    if version is None or not OLDEST <= version <= VERSION:
        return None
    _upgrade(text, version, STEPS, VERSION)
    return version


def _version(text: YamlText, inherited: int | None, target: int) -> int:
    node, said = text.node("version"), text.value("version")
    if node is None and inherited is not None:
        return inherited
    line = 1 if node is None else node.start_mark.line + 1
    if said is None or not said.isdecimal():
        raise ConfigError(f"{text.path}:{line}: version: expected a number of 0 to {target}, found {said!r}")
    if int(said) > target:
        raise ConfigError(f"{text.path}:{line}: version: {said} is newer than this program, which knows up to {target}")
    return int(said)


def _includes(text: YamlText) -> list[str]:
    node = text.node("include")
    nodes: Sequence[Node] = node.value if isinstance(node, SequenceNode) else [node] if node else []
    return [inner.value for inner in nodes if isinstance(inner, ScalarNode)]


def carry_out(upgrades: Sequence[Upgrade]) -> None:
    """Write the files, each whole or not at all, with the previous one next to it.

    Raises:
        InputError: a previous file of another content is kept there already, or one cannot be written.
    """
    for upgrade in upgrades:
        try:
            if upgrade.kept.exists() and upgrade.kept.read_text(encoding="utf-8") != upgrade.before:
                raise InputError(f"{upgrade.kept}: holds another version {upgrade.version} already; move it away")
            replace_file(upgrade.kept, upgrade.before)
            replace_file(upgrade.path, upgrade.after)
        except OSError as error:
            raise InputError(f"{upgrade.path}: {error.strerror or error}") from error
