"""The paper's figures 6 to 15, from our runs."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from monstertruckd.tools.figures import new_figure, write_figure
from monstertruckd.tools.study.analysis import Circle, centre_track, velocities
from monstertruckd.tools.study.log import Run
from monstertruckd.tools.study.report import Result

Draw = Callable[[Any, Run, Any], None]


def _track(axes: Any, run: Run, _found: Any) -> None:
    axes.plot(run.poses[0], run.poses[1], linewidth=0.8, label=run.name)
    axes.set_aspect("equal")
    axes.set(xlabel="X, m", ylabel="Y, m")


def _velocity(axes: Any, run: Run, _found: Any) -> None:
    times, (vx, vy) = velocities(run.times, run.poses)
    axes.plot(times, 100 * vx, linewidth=0.8, label=f"dX/dt, {run.name}")
    axes.plot(times, 100 * vy, linewidth=0.8, linestyle="--", label=f"dY/dt, {run.name}")
    axes.set(xlabel="time, s", ylabel="velocity in the stand's frame, cm/s")


def _centre(axes: Any, run: Run, found: Circle) -> None:
    track = centre_track(run.poses, found)
    at = run.times - run.times[0]
    smoothed = 20  # poses over which the centre of rotation is averaged in the picture
    for name, row, start, drift in zip("XY", track, found.centre, found.drift, strict=True):
        window = np.ones(smoothed) / smoothed
        smooth = 1000 * (np.convolve(row, window, "valid") - start)
        (drawn,) = axes.plot(run.times[smoothed // 2 :][: smooth.size], smooth, linewidth=0.5, alpha=0.6)
        label = f"{name}, {run.name}: {1000 * drift:.3f} mm/s"
        axes.plot(run.times, 1000 * drift * at, color=drawn.get_color(), label=label)
    axes.set(xlabel="time, s", ylabel="centre of rotation relative to its start, mm")


def _places(axes: Any, run: Run, _found: Any) -> None:
    for name, row in zip("XY", run.poses[:2], strict=True):
        axes.plot(run.times, row, linewidth=0.8, label=name)
    axes.set(xlabel="time, s", ylabel="m")


def _passes(axes: Any, run: Run, _found: Any) -> None:
    axes.plot(100 * run.poses[0], 100 * run.poses[1], linewidth=0.6)
    axes.set(xlabel="X, cm", ylabel="Y, cm (another scale)")


FIGURES: Final[tuple[tuple[int, str, float | None, Draw], ...]] = (
    (6, "Track of a circle, 2:1", 2.0, _track),
    (7, "Track of a circle, 3:1 (captioned 2:1 in the paper)", 3.0, _track),
    (8, "Velocity, 2:1", 2.0, _velocity),
    (9, "Velocity, 3:1", 3.0, _velocity),
    (10, "Centre of rotation, 2:1", 2.0, _centre),
    (11, "Centre of rotation, 3:1", 3.0, _centre),
    (12, "Track, one side locked", np.inf, _track),
    (13, "Velocity, one side locked", np.inf, _velocity),
    (14, "X and Y on the line", None, _places),
    (15, "Tracks of the passes there and back", None, _passes),
)
"""Number, title, ratio of its circles (None for the line), and drawing of each run."""


def draw(results: Sequence[Result], folder: Path) -> list[Path]:
    """Draw the figures with runs; return the files, ``figure_06.png`` and so on.

    Raises:
        NotInstalledError: matplotlib is not installed.
        InputError: a file cannot be written.
    """
    written = []
    for number, title, ratio, what in FIGURES:
        chosen = [(run, found) for run, found in results if _belongs(run, ratio)]
        if what is _velocity:
            chosen = chosen[:1]
        if not chosen:
            continue
        drawing = new_figure(6.0, 4.5)
        axes = drawing.add_subplot()
        for run, found in chosen:
            what(axes, run, found)
        axes.set_title(f"{number}. {title}", fontsize="medium")
        axes.grid(visible=True, alpha=0.3)
        if axes.get_legend_handles_labels()[0]:
            axes.legend(fontsize="x-small")
        path = folder / f"figure_{number:02d}.png"
        write_figure(drawing, path)
        written.append(path)
    return written


def _belongs(run: Run, ratio: float | None) -> bool:
    if run.straight or ratio is None:
        return run.straight and ratio is None
    slow, fast = sorted((abs(run.left), abs(run.right)))
    found = np.inf if slow == 0 else fast / slow
    return bool(found == ratio or abs(found - ratio) < 0.05)
