"""monstertruckd: one asyncio daemon that owns every device of a four-wheel-steer robot truck."""

from importlib import import_module
from typing import Any

__version__ = "0.1.0"


def open_log(path: Any) -> Any:
    """Open a recorded log for analysis (extra ``tables``); see ``monstertruckd.tools.logs.opened.OpenedLog``.

    Raises:
        NotInstalledError: the extra is not installed.
        NotFoundError: no such file.
        InputError: not an MCAP file.
    """
    # Loaded on use: `--help` stays light.
    with import_module("monstertruck_runtime.extras").needs_extra("tables"):
        opened = import_module("monstertruckd.tools.logs.opened")
    return opened.OpenedLog(path)
