"""Code that pages show of the packages: a page marks the place with ``<!-- source: module:Class.method -->``."""

import importlib
import inspect
import re
import textwrap

MARK = re.compile(r"^<!-- source: (?P<module>[\w.]+):(?P<name>[\w.]+) -->$", re.MULTILINE)


def shown(markdown: str) -> str:
    """Return ``markdown`` with the code of the packages below every mark.

    Raises:
        ImportError: no such module.
        AttributeError: no such name in it.
    """
    return MARK.sub(lambda found: f"{found[0]}\n```python\n{_code(found['module'], found['name'])}```", markdown)


def _code(module: str, name: str) -> str:
    found = importlib.import_module(module)
    for part in name.split("."):
        found = getattr(found, part)
    return textwrap.dedent(inspect.getsource(found))
