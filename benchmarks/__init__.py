"""Benchmarks of monstertruckd: ``python -m benchmarks.NAME`` in a checkout; each describes itself with ``--help``."""

import sys
from pathlib import Path
from typing import Final

ROOT: Final = Path(__file__).resolve().parents[1]
"""Folder of the checkout."""

# A benchmark may use kits of the tests, and an installed package may also contain a module named `tests`.
sys.path.insert(0, str(ROOT))
