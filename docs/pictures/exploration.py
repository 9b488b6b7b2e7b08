"""One exploration of the built-in rooms as a series of pictures: ``python docs/pictures/exploration.py``.

The light harness of the exploration benchmark: real grid, exploring step and route planner, lidar with its noise.
"""

import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT / "benchmarks"))

from exploration_parts.arena import BODY, Arena
from exploration_parts.rover import Rover

from monstertruck_estimation.slam.worker_io import GridPatch
from monstertruck_planners.collision import OCCUPIED
from monstertruck_planners.explore.catalog import EXPLORERS
from monstertruck_planners.explore.exchange import Viewpoint
from monstertruck_planners.explore.explore_step import warm_up
from monstertruckd.tools.figures import new_figure, write_figure

WORLD, KIND, SEED, PICTURES = "rooms", "information", 3, 6


@dataclass(frozen=True)
class Moment:
    """The known map, the number of decisions so far, and the chosen viewpoint."""

    grid: GridPatch
    count: int
    target: Viewpoint | None


class Watched(Rover):
    """Rover that keeps a moment for every decision."""

    def __init__(self, *arguments: Any) -> None:
        super().__init__(*arguments)
        self.series: list[Moment] = []

    def choose(self, current: Viewpoint | None, pursued: float) -> Viewpoint | None:
        """Note the decision."""
        chosen = super().choose(current, pursued)
        self.note(chosen)
        return chosen

    def note(self, target: Viewpoint | None) -> None:
        """Keep this moment."""
        patch = self.grid.patch()
        self.series.append(Moment(replace(patch, cells=patch.cells.copy()), len(self.run.track), target))


def main() -> None:
    """Draw it."""
    warm_up()
    arena = Arena.load(WORLD, ROOT / "configs" / "worlds" / f"{WORLD}.yaml")
    rover = Watched(arena, EXPLORERS[KIND].settings_class()(), SEED)
    done = rover.explore()
    rover.take_stock()
    rover.note(None)
    track = np.array(done.track)
    figure = new_figure(12, 7)
    axes = figure.subplots(2, PICTURES // 2).ravel()
    for ax, k in zip(axes, np.linspace(0, len(rover.series) - 1, PICTURES).round().astype(int), strict=True):
        draw(ax, arena, rover.series[k], track)
    write_figure(figure, Path(__file__).parent / "exploration.png")


def draw(ax: Axes, arena: Arena, moment: Moment, track: np.ndarray) -> None:
    """Draw a moment: the known map, the path so far, the truck and its viewpoint."""
    grid, (rows, columns) = moment.grid, moment.grid.cells.shape
    left, low = grid.origin
    known = np.where(grid.cells < 0, 0.75, np.where(grid.cells >= OCCUPIED, 0.0, 1.0))
    box = (left, left + columns * grid.resolution, low, low + rows * grid.resolution)
    ax.imshow(known, origin="lower", extent=box, cmap="gray", vmin=0, vmax=1)
    way = track[: moment.count]
    ax.plot(way[:, 0], way[:, 1], lw=1.5, c="tab:blue")
    ax.plot(*way[0, :2], "s", c="tab:green", ms=6)
    ax.plot(*way[-1, :2], "o", c="tab:blue", ms=1e2 * BODY.width / 5)
    if moment.target is not None:
        ax.plot(*moment.target.frontier, "x", c="tab:red", ms=9, mew=2)
    rows, columns = arena.blocked.shape
    ax.set_xlim(arena.origin[0], arena.origin[0] + columns * arena.resolution)
    ax.set_ylim(arena.origin[1], arena.origin[1] + rows * arena.resolution)
    ax.set_facecolor("0.75")
    ax.set_xticks([])
    ax.set_yticks([])
    ax.set_title(f"{way[-1, 2]:.0f} m, {way[-1, 3]:.0%} known")


if __name__ == "__main__":
    main()
