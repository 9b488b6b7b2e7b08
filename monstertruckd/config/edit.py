"""Edits of YAML text in place: whatever is not named stays as it is, comments too. Pure."""

from pathlib import Path

from ruamel.yaml.nodes import CollectionNode, MappingNode, Node, ScalarNode

from monstertruckd.config.load import compose, reader


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

    def _root(self) -> MappingNode | None:
        return compose(reader(), self.text, self._path)

    def node(self, *key: str) -> Node | None:
        """What stands at ``key``; None if nothing does."""
        pair = self._pair(key)
        return None if pair is None else pair[1]

    def value(self, *key: str) -> str | None:
        """The plain value at ``key`` as it is written, without quotes; None for anything else."""
        node = self.node(*key)
        return node.value if isinstance(node, ScalarNode) else None

    def names(self, *key: str) -> list[str]:
        """Keys of the mapping at ``key``; none if there is no mapping."""
        node = self.node(*key) if key else self._root()
        return [name.value for name, _ in node.value] if isinstance(node, MappingNode) else []

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

    def _pair(self, key: tuple[str, ...]) -> tuple[Node, Node] | None:
        node = self._root()
        pair = None
        for part in key:
            if not isinstance(node, MappingNode):
                return None
            pair = next(((name, value) for name, value in node.value if name.value == part), None)
            if pair is None:
                return None
            node = pair[1]
        return pair


def _end(node: Node) -> int:
    """Index behind the node's last character; a block's own mark lies behind the blanks and comments after it."""
    if isinstance(node, CollectionNode) and not node.flow_style and node.value:
        last = node.value[-1]
        return _end(last[1] if isinstance(last, tuple) else last)
    end: int = node.end_mark.index
    return end
