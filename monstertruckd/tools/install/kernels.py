"""Compiles kernels ahead of their first use: ``python -m monstertruckd.tools.install.kernels``.

Those of all workers and of the emulated camera. numba keeps them next to the modules, or in ``NUMBA_CACHE_DIR``. Where
they are up to date this takes seconds.
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
    """Build every worker once, and draw a picture; what needs packages that are not installed is left out.

    Args:
        report: gets a line before each of them.
    """
    targets = (*WORKERS, CAMERA)
    for number, target in enumerate(targets, 1):
        module, _, factory = target.partition(":")
        report(f"  {number} of {len(targets)}: {module}")
        with suppress(ModuleNotFoundError):
            getattr(importlib.import_module(module), factory)()


if __name__ == "__main__":
    compile_kernels(lambda line: sys.stderr.write(f"{line}\n"))
