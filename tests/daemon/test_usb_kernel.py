"""``benchmarks/usb_kernel.py``: serial ports, hubs and udev on a real kernel; two to four minutes."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]

pytestmark = [pytest.mark.wall, pytest.mark.long, pytest.mark.timeout(800)]


def test_every_situation_on_a_real_kernel():
    command = [sys.executable, str(ROOT / "benchmarks" / "usb_kernel.py")]
    done = subprocess.run(command, capture_output=True, text=True, timeout=750, check=False)
    found = json.loads(done.stdout.splitlines()[-1])
    if "skipped" in found:
        pytest.skip(f"usb_kernel: {found['skipped']}")
    situations = found["figures"]["situations"]
    assert found["figures"]["exit"] == 0, done.stdout
    assert [name for name, one in situations.items() if not one["ok"]] == [], done.stdout
    slept = {name: one["calls"] for name, one in situations.items() if one["in_kernel_ms"] > 2.0}
    assert slept == {}
    assert found["met"]
