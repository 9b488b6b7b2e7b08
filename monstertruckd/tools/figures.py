"""Figures of results: matplotlib is loaded when one is drawn, and every figure is written in the same way."""

from pathlib import Path
from typing import TYPE_CHECKING

from monstertruck_runtime.errors import InputError
from monstertruck_runtime.extras import not_installed
from monstertruck_runtime.small_files import require_place

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def new_figure(width: float, height: float) -> "Figure":
    """Return an empty figure of this size (inches).

    Raises:
        NotInstalledError: matplotlib is not installed.
    """
    try:
        from matplotlib.figure import Figure  # noqa: PLC0415  # optional
    except ImportError as error:
        raise not_installed("figures: matplotlib", "plot") from error
    return Figure(figsize=(width, height), layout="constrained")


def require_drawable(path: Path) -> None:
    """Refuse a picture that cannot be written, before the minutes whose result it is to show.

    Raises:
        NotInstalledError: matplotlib is not installed.
        InputError: it has no ending of a picture.
        OSError: nothing can be written there.
    """
    known = new_figure(1.0, 1.0).canvas.get_supported_filetypes()
    if path.suffix[1:].lower() not in known:
        raise InputError(f"{path}: expected a name that ends with .png or another of {', '.join(sorted(known))}")
    path.parent.mkdir(parents=True, exist_ok=True)
    require_place(path)


def write_figure(figure: "Figure", path: Path, kind: str | None = None) -> None:
    """Write a figure, by its ending or of a ``kind`` such as png; its folder is made.

    Raises:
        InputError: the file cannot be written.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(path, dpi=110, format=kind)
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: cannot be drawn: {getattr(error, 'strerror', None) or error}") from error
