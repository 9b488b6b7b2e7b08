"""Code shown in pages: taken from the package when the site is built, so that it is never older than the code."""

import importlib
import inspect
import re
import textwrap

DIRECTIVE = re.compile(r"^<!-- source: ([\w.]+):([\w.]+) -->$", re.MULTILINE)


def shown(markdown: str) -> str:
    """``markdown`` with every ``<!-- source: module:Class.method -->`` replaced by that code.

    Raises:
        ImportError: no such module.
        AttributeError: no such name in it.
    """
    return DIRECTIVE.sub(lambda found: f"```python\n{_code(found[1], found[2])}```", markdown)


def _code(module: str, name: str) -> str:
    found = importlib.import_module(module)
    for part in name.split("."):
        found = getattr(found, part)
    return textwrap.dedent(inspect.getsource(found))
