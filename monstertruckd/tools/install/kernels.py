"""Compiles kernels ahead of their first use: ``python -m monstertruckd.tools.install.kernels``.

Those of all workers and of the emulated camera. numba keeps them next to the modules, or in ``NUMBA_CACHE_DIR``. Where
they are up to date this takes seconds. ``--background`` leaves the processor to others: beside two busy programs that
takes ten times as long, which nobody should wait for.
"""

import importlib
import os
import sys
from contextlib import suppress
from typing import Final

from monstertruck_estimation.slam.service import TARGET
from monstertruck_planners.steps import STEPS

WORKERS: Final = (TARGET, *STEPS.values())
"""``module:factory``; each compiles when it is built."""
BACKGROUND: Final = "--background"
CAMERA: Final = "monstertruck_sim.world.camera:compile_kernels"


def compile_kernels() -> None:
    """Build every worker once, and draw a picture; what needs packages that are not installed is left out."""
    for target in (*WORKERS, CAMERA):
        module, _, factory = target.partition(":")
        with suppress(ModuleNotFoundError):
            getattr(importlib.import_module(module), factory)()


if __name__ == "__main__":
    if BACKGROUND in sys.argv[1:]:
        os.nice(10)
    compile_kernels()
