"""Compiles kernels ahead of their first use: ``python -m monstertruckd.tools.install.kernels``.

Includes those of all workers and of the emulated camera. numba stores them next to the modules, or in
``NUMBA_CACHE_DIR``. Takes seconds if they are up to date.
"""

import importlib
import sys
from collections.abc import Callable
from contextlib import suppress
from typing import Final

from monstertruck_estimation.slam.service import TARGET
from monstertruck_planners.steps import STEPS

WORKERS: Final = (TARGET, *STEPS.values())
"""``module:factory``; each compiles when it is built."""
CAMERA: Final = "monstertruck_sim.world.camera:compile_kernels"


def compile_kernels(report: Callable[[str], object] = lambda _: None) -> None:
    """Build every worker once, and draw an image; work that needs missing packages is skipped.

    Args:
        report: receives a line before each of them.
    """
    targets = (*WORKERS, CAMERA)
    for number, target in enumerate(targets, 1):
        module, _, factory = target.partition(":")
        report(f"  {number} of {len(targets)}: {module}")
        with suppress(ModuleNotFoundError):
            getattr(importlib.import_module(module), factory)()


if __name__ == "__main__":
    compile_kernels(lambda line: sys.stderr.write(f"{line}\n"))
