"""Edits of YAML text in place: whatever is not named stays as it is, comments too. Pure."""

import json
import stat
from pathlib import Path
from typing import Any, Final, Self

from ruamel.yaml import YAML
from ruamel.yaml.composer import Composer, ComposerError, MaxDepthExceededError
from ruamel.yaml.error import MarkedYAMLError, YAMLError
from ruamel.yaml.nodes import CollectionNode, MappingNode, Node, ScalarNode, SequenceNode
from ruamel.yaml.reader import ReaderError

from monstertruck_runtime.errors import ConfigError

MOST_BYTES: Final = 1_000_000
"""Of one file."""
DEEPEST: Final = 50
"""Sections and lists within each other."""
MOST_NODES: Final = 5_000
"""Keys and values of one file as they are written: read in a quarter of a second; a full configuration has some
hundreds."""


class _BoundedComposer(Composer):
    """Builds the nodes of one document, until there are too many."""

    count = 0

    def compose_node(self, parent: Any, index: Any) -> Any:
        """One node with all below it."""
        self.count += 1
        if self.count > MOST_NODES:
            place = self.parser.peek_event().start_mark
            raise ComposerError(None, None, f"more than {MOST_NODES} keys and values", place)
        return super().compose_node(parent, index)


def reader() -> YAML:
    """Reads one document of plain data."""
    yaml = YAML(typ="safe", pure=True)
    yaml.max_depth = DEEPEST
    yaml.Composer = _BoundedComposer
    return yaml


def node_kind(node: Node) -> str:
    """What stands there, for complaints."""
    kinds = ((MappingNode, "a mapping"), (SequenceNode, "a list"))
    return next((name for kind, name in kinds if isinstance(node, kind)), "a plain value")


def _compose(text: str, path: Path) -> MappingNode | None:
    _check_directives(text, path)
    try:
        node = reader().compose(text)
    except ReaderError as error:
        line = text.count("\n", 0, error.position) + 1
        raise ConfigError(
            f"{path}:{line}: not valid YAML: character {chr(error.character)!r} is not allowed"
        ) from error
    except MarkedYAMLError as error:
        line = error.problem_mark.line + 1 if error.problem_mark else 1
        too_deep = isinstance(error, MaxDepthExceededError)
        problem = f"nested more than {DEEPEST} times" if too_deep else f"not valid YAML: {error.problem}"
        raise ConfigError(f"{path}:{line}: {problem}") from error
    except YAMLError as error:
        raise ConfigError(f"{path}:1: not valid YAML: {error}") from error
    if node is not None and not isinstance(node, MappingNode):
        raise ConfigError(f"{path}:1: expected a mapping of sections, found {node_kind(node)}")
    return node


def _check_directives(text: str, path: Path) -> None:
    for number, line in enumerate(text.removeprefix("\ufeff").splitlines(), 1):
        words = line.split()
        if words and not line.startswith(("%", "#")):
            return
        if words[:1] == ["%YAML"] and words[1:2] != ["1.2"]:
            raise ConfigError(f"{path}:{number}: {line.strip()}: expected YAML 1.2; leave this line out")


def check_size(path: Path) -> None:
    """Refuse what would take for ever, or too much memory, to read.

    Raises:
        ConfigError: a pipe, a device, or longer than ``MOST_BYTES``.
        OSError: there is nothing to read.
    """
    status = path.stat()
    if stat.S_ISFIFO(status.st_mode) or stat.S_ISCHR(status.st_mode):
        raise ConfigError(f"{path}: cannot be read: not a file of text")
    if (size := status.st_size) > MOST_BYTES:
        raise ConfigError(f"{path}:1: {size} bytes: expected at most {MOST_BYTES}")


class YamlText:
    """A YAML mapping, or nothing, as text.

    Args:
        text: content.
        path: its file, for complaints.

    Raises:
        ConfigError: it is not YAML 1.2, is nested too deeply, or is something else than a mapping.
    """

    def __init__(self, text: str, path: Path) -> None:
        self.path = path
        self._set(text)

    @classmethod
    def read(cls, path: Path) -> Self:
        """Content of a file.

        Raises:
            ConfigError: it cannot be read, is longer than ``MOST_BYTES``, or is refused as above.
        """
        try:
            check_size(path)
            return cls(path.read_text(encoding="utf-8"), path)
        except (OSError, UnicodeDecodeError) as error:
            reason = error.strerror if isinstance(error, OSError) else "not UTF-8 text"
            raise ConfigError(f"{path}: cannot be read: {reason}") from error

    def _set(self, text: str) -> None:
        self.text = text
        self.root = _compose(text, self.path)

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
        node = self.node(*key) if key else self.root
        return [name.value for name, _ in node.value] if isinstance(node, MappingNode) else []

    def replace(self, key: tuple[str, ...], text: str) -> bool:
        """Write ``text`` where the value at ``key`` stands; False if there is none."""
        node = self.node(*key)
        if node is None:
            return False
        self._set(self.text[: node.start_mark.index] + text + self.text[_end(node) :])
        return True

    def rename(self, key: tuple[str, ...], name: str) -> bool:
        """Call the last part of ``key`` by another name; False if it is not there."""
        pair = self._pair(key)
        if pair is None:
            return False
        start, end = pair[0].start_mark.index, pair[0].end_mark.index
        quoted = json.dumps(name) if self.text[start] in "\"'" else name
        self._set(self.text[:start] + quoted + self.text[end:])
        return True

    def _pair(self, key: tuple[str, ...]) -> tuple[Node, Node] | None:
        node = self.root
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
