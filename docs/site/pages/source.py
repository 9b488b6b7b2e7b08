"""Code that pages show of the packages: in the pages themselves, and equal to what runs.

``python docs/site/pages/source.py`` writes it anew below every ``<!-- source: module:Class.method -->``; a test holds
that there is nothing to write.
"""

import importlib
import inspect
import re
import textwrap
from pathlib import Path

BLOCK = re.compile(
    r"^(?P<mark><!-- source: (?P<module>[\w.]+):(?P<name>[\w.]+) -->)\n(?:\n?```python\n.*?^```\n)?",
    re.MULTILINE | re.DOTALL,
)
DOCS = Path(__file__).resolve().parents[2]


def refreshed(markdown: str) -> str:
    """``markdown`` with the present code below every mark.

    Raises:
        ImportError: no such module.
        AttributeError: no such name in it.
    """
    return BLOCK.sub(
        lambda found: f"{found['mark']}\n```python\n{_code(found['module'], found['name'])}```\n", markdown
    )


def _code(module: str, name: str) -> str:
    found = importlib.import_module(module)
    for part in name.split("."):
        found = getattr(found, part)
    return textwrap.dedent(inspect.getsource(found))


def main() -> None:
    """Write the pages whose code is older."""
    for page in sorted(DOCS.rglob("*.md")):
        text = page.read_text(encoding="utf-8")
        if (new := refreshed(text)) != text:
            page.write_text(new, encoding="utf-8")


if __name__ == "__main__":
    main()
