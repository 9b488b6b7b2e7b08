"""YAML 1.2 files of plain data."""

import io
from functools import partial
from pathlib import Path
from typing import Any, Final

from ruamel.yaml import YAML
from ruamel.yaml.composer import Composer, ComposerError, MaxDepthExceededError
from ruamel.yaml.error import MarkedYAMLError
from ruamel.yaml.events import AliasEvent

from monstertruck_runtime.errors import InputError
from monstertruck_runtime.outside import reading, text_of

LARGEST_YAML: Final = 1_000_000
"""Size of one file at most: they are written by hand, or give the origin of a map."""
_EXPECTED: Final = "YAML"


class _BoundedComposer(Composer):
    """Builds the nodes of one document up to a maximum number.

    Args:
        loader: loader of the document.
        most: maximum number of nodes.
        expand: whether to count the target of an alias each time; otherwise the reader bounds it.
    """

    def __init__(self, loader: Any = None, *, most: int, expand: bool) -> None:
        super().__init__(loader)
        self._most, self._expand = most, expand
        self._count = 0
        self._sizes: dict[int, int] = {}
        """Number of nodes in each complete node, by its id."""

    def compose_node(self, parent: Any, index: Any) -> Any:
        """Compose a node and everything below it, and count both."""
        alias, place = self.parser.check_event(AliasEvent), self.parser.peek_event().start_mark
        before = self._count
        self._count += 1
        node = super().compose_node(parent, index)
        if alias and self._expand:
            if id(node) not in self._sizes:
                raise ComposerError(None, None, "an alias inside its own anchor", place)
            self._count += self._sizes[id(node)]
        elif not alias:
            self._sizes[id(node)] = self._count - before
        if self._count > self._most:
            raise ComposerError(None, None, f"more than {self._most} keys and values", place)
        return node


# 20_000: maximum number of keys and values in one file, counting aliased ones each time: read in a second
def bounded_yaml(most: int = 20_000, *, expand: bool = True) -> YAML:
    """Return a reader of one document of plain data with limited depth and size; see ``_BoundedComposer``."""
    yaml = YAML(typ="safe", pure=True)
    yaml.max_depth = 50
    yaml.Composer = partial(_BoundedComposer, most=most, expand=expand)  # type: ignore[assignment]  # it is only called
    return yaml


def read_yaml(path: Path) -> Any:
    """Content of a file.

    Raises:
        InputError: it cannot be read, is not YAML, or is too large or nested too deeply.
    """
    text = text_of(path, _EXPECTED, LARGEST_YAML)
    with reading(path, _EXPECTED):
        try:
            return bounded_yaml().load(text)
        except MarkedYAMLError as error:
            line = error.problem_mark.line + 1 if error.problem_mark else 1
            raise InputError(f"{path}:{line}: {yaml_problem(error)}") from error


def yaml_problem(error: MarkedYAMLError) -> str:
    """Return the error in a text that is not valid YAML, or is nested too deeply."""
    if isinstance(error, MaxDepthExceededError):
        return f"nested more than {bounded_yaml().max_depth} times"
    return f"not valid YAML: {error.problem}"


def yaml_text(value: Any) -> str:
    """Format plain data as YAML in block style; keys keep their order."""
    yaml, text = YAML(typ="safe", pure=True), io.StringIO()
    yaml.default_flow_style = False
    yaml.sort_base_mapping_type_on_output = False  # type: ignore[assignment]  # its annotation knows None only
    yaml.dump(value, text)
    return text.getvalue()
