"""``python -m tests.make_summaries``: the first paragraph of each command's help, which `--help` lists.

To be made anew when a command is added, or the first paragraph of its docstring changes.
"""

import json
from typing import Any

from typer.main import get_command

from monstertruckd.tools.cli.entry import SUMMARIES
from monstertruckd.tools.cli.main import app


def summaries() -> dict[str, str | None]:
    """Return the summaries by command, None for hidden ones, in the order of the help."""
    group: Any = get_command(app)
    return {name: None if each.hidden else each.help.split("\n\n")[0] for name, each in group.commands.items()}


if __name__ == "__main__":
    SUMMARIES.write_text(json.dumps(summaries(), indent=2, ensure_ascii=False) + "\n", encoding="utf-8")
