"""The map as text."""

import math

import numpy as np
from rich.console import Console

from monstertruck_schemas.base import Pose2D
from monstertruck_schemas.state import Grid
from monstertruckd.tools.demo.picture import COLOURS, FREE, WALL, MapScreen, map_text

ORIGIN = Pose2D(x=0.0, y=0.0, yaw=0.0)
FLOOR, BRICK = COLOURS[FREE], COLOURS[WALL]


def grid(rows: list[str], resolution: float = 0.5, origin: Pose2D = ORIGIN) -> Grid:
    """A map drawn north up: ``#`` wall, ``.`` free, others unknown."""
    cells = [{"#": 100, ".": 0}.get(sign, -1) for row in reversed(rows) for sign in row]
    return Grid(
        stamp=1,
        received=1,
        seq=1,
        resolution=resolution,
        width=len(rows[0]),
        height=len(rows),
        origin=origin,
        cells=np.array(cells, dtype=np.int8),
    )


ROOM = grid(["      ", " #### ", " #..# ", " #..# ", " #### ", "      "])


def test_only_the_known_part_is_drawn_two_cells_in_a_character():
    text = map_text(ROOM, None, 80, 20)
    assert text.plain == "▀▀▀▀\n▀▀▀▀\n"
    assert str(text.spans[1].style) == f"{BRICK} on {FLOOR}", "wall above floor"
    assert str(text.spans[5].style) == f"{FLOOR} on {BRICK}"


def test_the_robot_is_an_arrow_at_its_place():
    for turns, arrow in enumerate("→↗↑↖←↙↓↘"):
        text = map_text(ROOM, Pose2D(x=1.2, y=1.1, yaw=turns * math.pi / 4), 80, 20)
        assert text.plain == f"▀▀▀▀\n▀{arrow}▀▀\n"
    turned = grid(["..", "##"], origin=Pose2D(x=1.0, y=0.0, yaw=math.pi / 2))
    assert map_text(turned, Pose2D(x=0.8, y=0.2, yaw=math.pi / 2), 80, 20).plain == "→▀\n"
    assert map_text(ROOM, Pose2D(x=50.0, y=1.1, yaw=0.0), 80, 20).plain == "▀▀▀▀\n▀▀▀▀\n"


def test_a_map_that_is_too_large_shrinks_and_keeps_its_walls():
    wide = grid(["." * 40 + "#"] * 3)
    text = map_text(wide, None, 10, 20)
    (line,) = text.plain.splitlines()
    assert len(line) == 9
    assert BRICK in str(text.spans[-1].style)
    assert len(map_text(grid(["#"] * 40), None, 80, 5).plain.splitlines()) == 5


def test_before_the_first_map_the_line_alone_is_shown():
    assert map_text(grid(["   "]), None, 80, 20).plain == ""
    console = Console(width=30, height=10, force_terminal=True)
    with console.capture() as shown, MapScreen(console) as screen:
        screen("0 s", None, None)
        screen("2 s  0.1 m", ROOM, Pose2D(x=1.0, y=1.0, yaw=0.0))
    assert "2 s  0.1 m" in shown.get()
    assert "→" in shown.get()
