"""Code that pages show: a paragraph that is only a link to a file becomes its code on the site.

A link to a file in ``examples/`` or to a configuration shows the whole file. A link to a module shows the class or
function that the link names, such as ``[PathTracker.steer](../planners/.../path_tracker.py)``.
"""

import ast
import re
import textwrap
from pathlib import Path

DOCS = Path(__file__).resolve().parents[2]
LINK = re.compile(r"^\[`?(?P<name>[\w./]+)`?\]\((?P<path>[\w./-]+\.(?P<kind>py|toml|yaml))\)$", re.MULTILINE)
LANGUAGES = {"py": "python", "toml": "toml", "yaml": "yaml"}


def shown(markdown: str) -> str:
    """Return ``markdown`` with code in place of every paragraph that links to it.

    Raises:
        OSError: no such file.
        LookupError: no such name in it.
    """
    return LINK.sub(_block, markdown)


def _block(found: re.Match[str]) -> str:
    text = (DOCS / found["path"]).read_text(encoding="utf-8")
    whole = found["kind"] != "py" or found["path"].startswith("examples/")
    code = text if whole else _part(text, found["name"])
    return f'```{LANGUAGES[found["kind"]]} title="{found["name"]}"\n{code.rstrip()}\n```'


def _part(module: str, name: str) -> str:
    """Return the source of a class, function or method of a module."""
    node: ast.AST = ast.parse(module)
    for part in name.split("."):
        node = _child(node, part)
    assert isinstance(node, ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef)
    first = min(node.lineno, *(decorator.lineno for decorator in node.decorator_list), node.lineno)
    return textwrap.dedent("\n".join(module.splitlines()[first - 1 : node.end_lineno]))


def _child(node: ast.AST, name: str) -> ast.AST:
    for child in ast.iter_child_nodes(node):
        if getattr(child, "name", None) == name:
            return child
    raise LookupError(f"no {name}")
