"""The command line starts soon: what a command needs beyond its options is loaded when it runs."""

import subprocess
import sys

SLOW = "asyncio ssl uvloop numpy pydantic zenoh rich.console monstertruck_runtime.clock monstertruckd.config.truck"


def test_the_help_is_shown_without_what_takes_long_to_load():
    code = f"""
import sys
from monstertruckd.tools.cli.main import app
try:
    app(["--help"])
finally:
    print([name for name in {SLOW.split()} if name in sys.modules], file=sys.stderr)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert "Usage" in done.stdout
    assert done.stderr == "[]\n"
