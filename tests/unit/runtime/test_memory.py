import subprocess
import sys
from pathlib import Path

import pytest

from monstertruck_runtime.memory import give_back

SETTLED = """
import gc, re
from pathlib import Path
from monstertruck_runtime.memory import settle
kept = [[] for _ in range(200_000)]
settle()
print(gc.get_freeze_count(), re.search(r"AnonHugePages: *([0-9]+)", Path("/proc/self/smaps_rollup").read_text())[1])
"""


def settled() -> tuple[int, int]:
    """Objects the collector looks at no more, and kB in huge pages, of a process with much on its heap."""
    run = subprocess.run([sys.executable, "-c", SETTLED], capture_output=True, check=True, text=True)
    frozen, huge = run.stdout.split()
    return int(frozen), int(huge)


def test_what_is_loaded_is_the_collectors_business_no_more():
    assert settled()[0] > 200_000


def test_what_is_loaded_moves_into_huge_pages():
    enabled = Path("/sys/kernel/mm/transparent_hugepage/enabled")
    if not enabled.exists() or "[never]" in enabled.read_text():
        pytest.skip("this kernel has no huge pages")
    assert settled()[1] > 2048


def test_giving_memory_back_harms_nothing():
    kept = [bytes(1000) for _ in range(1000)]
    give_back()
    assert all(len(part) == 1000 for part in kept)
