"""Map and robot as text for the terminal while a robot explores."""

import math
from types import TracebackType
from typing import Final, Self

import numpy as np
from numpy.typing import NDArray
from rich.console import Console, Group
from rich.live import Live
from rich.text import Text

from monstertruck_schemas.base import Pose2D
from monstertruck_schemas.state import Grid

UNKNOWN, FREE, WALL, ROBOT = range(4)
COLOURS: Final = ("grey15", "grey82", "grey35", "red")
"""Colours of the four kinds of cells, by their number."""
ARROWS: Final = "→↗↑↖←↙↓↘"
"""Headings in steps of 45 degrees."""


class MapScreen:
    """Map with a line below it, redrawn in place; the last picture remains.

    Args:
        console: console of a terminal.
    """

    def __init__(self, console: Console) -> None:
        self._console = console
        self._live = Live(console=console, auto_refresh=False)

    def __enter__(self) -> Self:
        self._live.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self._live.stop()

    def __call__(self, line: str, grid: Grid | None, pose: Pose2D | None) -> None:
        """Show a line of progress below the map, once there is one."""
        room = self._console.height - 2  # rows: the line, and the cursor below it
        picture = Text("") if grid is None else map_text(grid, pose, self._console.width, room)
        self._live.update(Group(picture, Text(line)), refresh=True)


def map_text(grid: Grid, pose: Pose2D | None, columns: int, rows: int) -> Text:
    """Draw the known part of a map, north up, in characters of two cells one above the other.

    Args:
        grid: the map.
        pose: pose of the robot in the map's frame; None to leave it out.
        columns: available characters per line.
        rows: available lines.
    """
    kinds = np.full((grid.height, grid.width), UNKNOWN, dtype=np.uint8)
    cells = grid.cells.reshape(grid.height, grid.width)
    kinds[cells >= 0] = FREE
    # Minimum value of a grid's wall cell.
    kinds[cells >= 50] = WALL
    known = np.argwhere(kinds)
    if not len(known):
        return Text("")
    (bottom, left), (top, right) = known.min(0), known.max(0) + 1
    step = max(math.ceil((right - left) / columns), math.ceil((top - bottom) / (2 * rows)), 1)
    blocks = reduced(kinds[bottom:top, left:right], step)
    heading = None
    if pose is not None:
        c, s = math.cos(grid.origin.yaw), math.sin(grid.origin.yaw)
        dx, dy = pose.x - grid.origin.x, pose.y - grid.origin.y
        column, row = (c * dx + s * dy) / grid.resolution - left, (c * dy - s * dx) / grid.resolution - bottom
        i, j = int(row // step), int(column // step)
        if 0 <= i < blocks.shape[0] and 0 <= j < blocks.shape[1]:
            heading = i // 2, j, ARROWS[round((pose.yaw - grid.origin.yaw) / (math.pi / 4)) % len(ARROWS)]
    text = Text()
    for line in range(blocks.shape[0] // 2 - 1, -1, -1):
        for column in range(blocks.shape[1]):
            lower, upper = blocks[2 * line, column], blocks[2 * line + 1, column]
            if heading is not None and heading[:2] == (line, column):
                text.append(heading[2], f"bold {COLOURS[ROBOT]} on {COLOURS[lower]}")
            else:
                text.append("▀", f"{COLOURS[upper]} on {COLOURS[lower]}")
        text.append("\n")
    return text


def reduced(kinds: NDArray[np.uint8], step: int) -> NDArray[np.uint8]:
    """Return the largest kind in every square of ``step`` cells; rows are padded to an even number."""
    height, width = kinds.shape
    rows, columns = math.ceil(height / step), math.ceil(width / step)
    padded = np.zeros(((rows + rows % 2) * step, columns * step), dtype=np.uint8)
    padded[:height, :width] = kinds
    found: NDArray[np.uint8] = padded.reshape(rows + rows % 2, step, columns, step).max(axis=(1, 3))
    return found
