"""Edits of YAML text in place: whatever is not named stays as it is, comments too. Pure."""

from pathlib import Path

import yaml

from monstertruck_runtime.errors import ConfigError


class YamlText:
    """A YAML mapping, or nothing, as text.

    Args:
        text: content.
        path: its file, for complaints.

    Raises:
        ConfigError: it is not YAML, or something else.
    """

    def __init__(self, text: str, path: Path) -> None:
        self.text = text
        self._path = path
        self._root()

    def _root(self) -> yaml.Node | None:
        try:
            node = yaml.compose(self.text, Loader=yaml.SafeLoader)
        except yaml.MarkedYAMLError as error:
            line = error.problem_mark.line + 1 if error.problem_mark else 1
            raise ConfigError(f"{self._path}:{line}: not valid YAML: {error.problem}") from error
        if node is not None and not isinstance(node, yaml.MappingNode):
            raise ConfigError(f"{self._path}:1: expected a mapping of sections")
        return node

    def node(self, *key: str) -> yaml.Node | None:
        """What stands at ``key``; None if nothing does."""
        pair = self._pair(key)
        return None if pair is None else pair[1]

    def value(self, *key: str) -> str | None:
        """The plain value at ``key`` as it is written, without quotes; None for anything else."""
        node = self.node(*key)
        return node.value if isinstance(node, yaml.ScalarNode) else None

    def names(self, *key: str) -> list[str]:
        """Keys of the mapping at ``key``; none if there is no mapping."""
        node = self.node(*key) if key else self._root()
        return [name.value for name, _ in node.value] if isinstance(node, yaml.MappingNode) else []

    def replace(self, key: tuple[str, ...], text: str) -> bool:
        """Write ``text`` where the value at ``key`` stands; False if there is none."""
        node = self.node(*key)
        if node is None:
            return False
        self.text = self.text[: node.start_mark.index] + text + self.text[_end(node) :]
        return True

    def rename(self, key: tuple[str, ...], name: str) -> bool:
        """Call the last part of ``key`` by another name; False if it is not there."""
        pair = self._pair(key)
        if pair is None:
            return False
        start, end = pair[0].start_mark.index, pair[0].end_mark.index
        self.text = self.text[:start] + name + self.text[end:]
        return True

    def _pair(self, key: tuple[str, ...]) -> tuple[yaml.Node, yaml.Node] | None:
        node = self._root()
        pair = None
        for part in key:
            if not isinstance(node, yaml.MappingNode):
                return None
            pair = next(((name, value) for name, value in node.value if name.value == part), None)
            if pair is None:
                return None
            node = pair[1]
        return pair


def _end(node: yaml.Node) -> int:
    """Index behind the node's last character; a block's own mark lies behind the blanks and comments after it."""
    if isinstance(node, yaml.CollectionNode) and not node.flow_style and node.value:
        last = node.value[-1]
        return _end(last[1] if isinstance(last, tuple) else last)
    end: int = node.end_mark.index
    return end
