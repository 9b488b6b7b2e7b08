import platform
import subprocess
import sys
from pathlib import Path

import pytest

SETTLED = """
import gc, re
from pathlib import Path
from monstertruck_runtime.memory import settle
kept = [[] for _ in range(200_000)]
settle()
print(gc.get_freeze_count(), re.search(r"AnonHugePages: *([0-9]+)", Path("/proc/self/smaps_rollup").read_text())[1])
"""

GIVEN_BACK = """
from pathlib import Path
from monstertruck_runtime.memory import give_back

def resident():
    return int(Path("/proc/self/statm").read_text().split()[1]) * 4096

blocks = [bytearray(1000) for _ in range(100_000)]
kept = blocks[::100]
del blocks
before = resident()
give_back()
print(before, resident())
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
    assert settled()[1] > 0


def test_free_memory_between_what_is_in_use_goes_back_to_the_system():
    run = subprocess.run([sys.executable, "-c", GIVEN_BACK], capture_output=True, check=True, text=True)
    before, after = map(int, run.stdout.split())
    if before == after and platform.libc_ver()[0] != "glibc":
        pytest.skip("only glibc gives memory back on request")
    assert after < before - 30_000_000
