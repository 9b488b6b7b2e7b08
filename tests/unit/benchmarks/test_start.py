"""Every benchmark starts: its imports hold, and its command line can be read."""

import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[3]
FILES = (ROOT / "benchmarks").glob("*.py")
BENCHMARKS = sorted(path.name for path in FILES if "ArgumentParser" in path.read_text())
"""Those that take arguments."""


@pytest.mark.long
@pytest.mark.parametrize("name", BENCHMARKS)
def test_a_benchmark_says_what_it_takes(name: str) -> None:
    command = [sys.executable, "-m", f"benchmarks.{name.removesuffix('.py')}", "--help"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stderr
    assert "usage" in done.stdout
