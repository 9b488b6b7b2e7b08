"""Shows a recording in the rerun viewer, which gets no way out of this computer.

The viewer listens on the loopback address alone. It would ask for newer versions and could send statistics: its
analytics are switched off in a configuration of its own (the user's stays as it is), and its way to the web is a proxy
that does not exist.
"""

import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Final

from monstertruck_runtime.errors import CommandFailedError

_NOWHERE: Final = "http://127.0.0.1:9"
"""The discard port: nobody listens there."""


def show(recording: Path) -> None:
    """Show a rerun file until the viewer is closed.

    Raises:
        CommandFailedError: there is no display, or the viewer failed.
    """
    if sys.platform == "linux" and not any(map(os.environ.get, ("DISPLAY", "WAYLAND_DISPLAY", "WAYLAND_SOCKET"))):
        raise CommandFailedError("the rerun viewer needs a display, and there is none; --save writes a file instead")
    with tempfile.TemporaryDirectory(prefix="monstertruckd-view-") as folder:
        confined = environment(Path(folder))
        _run(["analytics", "disable"], confined, quiet=True)
        _run(["--bind", "127.0.0.1", "--port", "auto", "--hide-welcome-screen", str(recording)], confined)


def environment(folder: Path) -> dict[str, str]:
    """Environment of a viewer that keeps its files in ``folder`` and reaches nobody outside."""
    names = ("ALL_PROXY", "HTTP_PROXY", "HTTPS_PROXY")
    proxies = {name: _NOWHERE for upper in names for name in (upper, upper.lower())}
    home = {name: str(folder) for name in ("XDG_CONFIG_HOME", "XDG_DATA_HOME", "XDG_CACHE_HOME")}
    local = dict.fromkeys(("NO_PROXY", "no_proxy"), "127.0.0.1,localhost")
    return dict(os.environ) | proxies | home | local


def _run(arguments: list[str], confined: dict[str, str], *, quiet: bool = False) -> None:
    command = [sys.executable, "-m", "rerun_cli", *arguments]
    output = subprocess.DEVNULL if quiet else None
    done = subprocess.run(command, env=confined, stdout=output, stderr=output, check=False)  # noqa: S603  # our own
    if done.returncode:
        msg = f"the rerun viewer ended with {done.returncode}; --save writes a file instead"
        raise CommandFailedError(msg)
