"""Upgrades configuration files of older versions step by step, keeping their comments.

A file without ``version`` has the version of the including file. The previous file is kept next to the new one as
``NAME.vN``. A file that includes others is written last, so an interrupted upgrade can be repeated: a step does not
change a key that is already current.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from ruamel.yaml.nodes import Node, ScalarNode, SequenceNode

from monstertruck_runtime.errors import ConfigError, InputError
from monstertruck_runtime.outside import contents_if_present
from monstertruck_runtime.small_files import replace_file
from monstertruck_runtime.yaml_files import LARGEST_YAML
from monstertruckd.config.load import FILE_VERSION, STEPS, Step, YamlText, included, run_steps


@dataclass(frozen=True, slots=True)
class Upgrade:
    """Upgrade of one file."""

    path: Path
    version: int
    """Current version of the file."""
    before: str
    after: str

    @property
    def kept(self) -> Path:
        """Path of the copy of the previous file."""
        return self.path.with_name(f"{self.path.name}.v{self.version}")


def plan(path: Path, steps: Mapping[int, Step] = STEPS, target: int = FILE_VERSION) -> list[Upgrade]:
    """Return the upgrades for ``path`` and all included files, in writing order.

    Args:
        path: configuration file.
        steps: migration steps.
        target: target version.

    Raises:
        ConfigError: a file is missing, is not a YAML mapping, or has an unknown version.
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
    text = YamlText.read(path)
    place = path.resolve()
    if place in including:
        raise ConfigError(f"{path}: includes itself through {' > '.join(map(str, including))}")
    if place in upgrades:
        return
    before, version = text.text, _version(text, inherited, steps, target)
    for name in _includes(text):
        _visit(included(path, name), version, steps, target, upgrades, (*including, place))
    run_steps(text, version, steps, target)
    upgrades[place] = Upgrade(path, version, before, text.text)


def _version(text: YamlText, inherited: int | None, steps: Mapping[int, Step], target: int) -> int:
    node, said = text.node("version"), text.value("version")
    if node is None and inherited is not None:
        return inherited
    line = 1 if node is None else node.start_mark.line + 1
    if said is None or not said.isdecimal() or int(said) < min(steps):
        raise ConfigError(f"{text.path}:{line}: version: expected {min(steps)} to {target}, found {said}")
    if int(said) > target:
        raise ConfigError(
            f"{text.path}:{line}: version: {said} is newer than this program, which supports up to {target}"
        )
    return int(said)


def _includes(text: YamlText) -> list[str]:
    node = text.node("include")
    nodes: Sequence[Node] = node.value if isinstance(node, SequenceNode) else [node] if node else []
    return [inner.value for inner in nodes if isinstance(inner, ScalarNode)]


def carry_out(upgrades: Sequence[Upgrade]) -> None:
    """Write each file atomically, with its previous version next to it.

    Raises:
        InputError: a different previous file already exists, or a file cannot be written.
    """
    for upgrade in upgrades:
        try:
            kept = contents_if_present(upgrade.kept, "a previous configuration", LARGEST_YAML)
            if kept is not None and kept != upgrade.before.encode():
                raise InputError(f"{upgrade.kept}: already contains another version {upgrade.version}; move it away")
            replace_file(upgrade.kept, upgrade.before)
            replace_file(upgrade.path, upgrade.after)
        except OSError as error:
            raise InputError(f"{upgrade.path}: {error.strerror or error}") from error
