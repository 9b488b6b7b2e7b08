"""A picture of every run of a tuning."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from monstertruck_runtime.errors import InputError
from monstertruck_runtime.small_files import require_place
from monstertruckd.tools.tune.runs import TuningRun

COLUMNS: Final = 4


def require_drawable(path: Path) -> None:
    """Refuse a picture that cannot be written, before the minutes whose result it is to show.

    Raises:
        InputError: it has no ending of a picture.
        OSError: nothing can be written there.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg  # noqa: PLC0415 - of this command only

    known = FigureCanvasAgg.get_supported_filetypes()
    if path.suffix[1:].lower() not in known:
        raise InputError(f"{path}: expected a name that ends with .png or another of {', '.join(sorted(known))}")
    path.parent.mkdir(parents=True, exist_ok=True)
    require_place(path)


def draw(runs: Sequence[TuningRun], path: Path) -> None:
    """Write the distance errors of all runs, in their order.

    Raises:
        InputError: the file cannot be written.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg  # noqa: PLC0415 - of this command only
    from matplotlib.figure import Figure  # noqa: PLC0415

    rows = math.ceil(len(runs) / COLUMNS)
    figure = Figure(figsize=(3.2 * COLUMNS, 2.4 * rows), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(rows, COLUMNS, squeeze=False, sharex=True, sharey=True).flat
    for place, (number, run) in zip(axes, enumerate(runs, 1), strict=False):
        times, errors = zip(*run.samples, strict=True)
        place.plot(times, [1000 * error for error in errors])
        place.axhline(0.0, color="grey", linewidth=0.5)
        place.set_title(f"{number}. " + run.text.replace(": ", "\n"), fontsize=8)
    figure.supxlabel("time since the step, s")
    figure.supylabel("distance error, mm")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(path, dpi=100)
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: {error}") from error
