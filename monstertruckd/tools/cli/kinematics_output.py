"""How the kinematics commands write facts, draw and refuse."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from monstertruckd.tools.cli.output import remark


@contextmanager
def refusals() -> Iterator[None]:
    """Turn what the library refuses into the command line's own error.

    Raises:
        InputError: for any KinematicsError of the block.
    """
    from monstertruck_kinematics.errors import KinematicsError
    from monstertruck_runtime.errors import InputError

    try:
        yield
    except KinematicsError as error:
        raise InputError(str(error)) from error


def text(value: object) -> str:
    """A fact as a word or a number."""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, tuple):
        return ", ".join(text(entry) for entry in value)
    return f"{value:.4g}" if isinstance(value, float) else str(value)


@contextmanager
def figure(path: Path, across: str, up: str) -> Iterator[Any]:
    """Axes of a picture that is written when the block ends.

    Raises:
        InputError: matplotlib is not installed, or the file cannot be written.
    """
    from monstertruck_runtime.errors import InputError

    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        raise InputError("--png needs matplotlib: install monstertruckd[plot]") from error
    drawing = Figure(figsize=(7.0, 5.0), layout="constrained")
    axes = drawing.add_subplot()
    axes.set_xlabel(across)
    axes.set_ylabel(up)
    axes.grid(visible=True, alpha=0.3)
    yield axes
    try:
        drawing.savefig(path, dpi=120, format="png")
    except OSError as error:
        raise InputError(f"{path}: {error.strerror}") from error
    remark(f"wrote {path}")
