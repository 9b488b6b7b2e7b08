"""Worlds drawn by code: two with laps (loop, circuit), rooms, a maze, a ramp, a yard, a table, a hall, a workshop.

``python -m monstertruck_sim.world.built_in configs`` writes them as map_server files, and the laps.
"""

import sys
from collections.abc import Callable
from dataclasses import dataclass
from math import pi, radians, tan
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from monstertruck_kinematics.elementary import Array
from monstertruck_runtime.map_files import FREE, OCCUPIED, UNKNOWN, WorldMap, save_map
from monstertruck_sim.world.terrain import Profile, profile_path, save_profile

DRAWN_RESOLUTION = 0.025
"""Resolution of the drawn maps (m/cell)."""
_WALL = 0.1


class RoundedRectangle(NamedTuple):
    """Length of a lap around the origin between the outer ends of its straights and arcs (m)."""

    length: float
    width: float
    radius: float

    def distances(self, canvas: "_Canvas") -> Array:
        """Distance of every cell from the lap (m): 0 on the lap, negative inside."""
        dx = np.maximum(abs(canvas.xs) - (self.length / 2 - self.radius), 0)
        dy = np.maximum(abs(canvas.ys) - (self.width / 2 - self.radius), 0)
        away: Array = np.hypot(dx, dy) - self.radius
        return away


LOOP = RoundedRectangle(4.6, 3.4, 1.0)
"""Lap of ``loop``: 14.28 m, 71 s at 0.2 m/s."""
CIRCUIT = RoundedRectangle(9.0, 6.4, 2.5)
"""Lap of ``circuit``: 26.5 m, 9 s at 3 m/s."""


def _widened(cells: NDArray[np.bool_], by: int) -> NDArray[np.bool_]:
    """Return the cells that have a set cell within ``by`` rows and columns."""
    for axis in range(cells.ndim):
        around = np.pad(cells, [(by, by) if axis == other else (0, 0) for other in range(cells.ndim)])
        cells = np.asarray(sliding_window_view(around, 2 * by + 1, axis).any(axis=-1))
    return cells


@dataclass(frozen=True, slots=True)
class BuiltIn:
    """A world: map, start pose (x, y, yaw) and the ground profile if it is not level."""

    map: WorldMap
    start: tuple[float, float, float]
    profile: Profile | None = None


class _Canvas:
    """Map canvas in metres: free space is cut out of solid cells, of which only a thin layer finally remains as wall.

    Args:
        x: lower and upper bound (m).
        y: lower and upper bound (m).
    """

    def __init__(self, x: tuple[float, float], y: tuple[float, float]) -> None:
        self._origin = (x[0], y[0])
        columns, rows = round((x[1] - x[0]) / DRAWN_RESOLUTION), round((y[1] - y[0]) / DRAWN_RESOLUTION)
        self.xs = x[0] + (np.arange(columns) + 0.5) * DRAWN_RESOLUTION
        self.ys = (y[0] + (np.arange(rows) + 0.5) * DRAWN_RESOLUTION)[:, None]
        self.free = np.zeros((rows, columns), dtype=np.bool_)

    def rectangle(self, x0: float, y0: float, x1: float, y1: float) -> NDArray[np.bool_]:
        inside: NDArray[np.bool_] = (self.xs > x0) & (self.xs < x1) & (self.ys > y0) & (self.ys < y1)
        return inside

    def disc(self, x: float, y: float, radius: float) -> NDArray[np.bool_]:
        inside: NDArray[np.bool_] = (self.xs - x) ** 2 + (self.ys - y) ** 2 < radius**2
        return inside

    def map(self) -> WorldMap:
        skin = _widened(self.free, round(_WALL / DRAWN_RESOLUTION)) & ~self.free
        cells = np.full(self.free.shape, UNKNOWN, dtype=np.int8)
        cells[self.free] = FREE
        cells[skin] = OCCUPIED
        return WorldMap(cells, DRAWN_RESOLUTION, self._origin)


def loop() -> BuiltIn:
    """A corridor 1.2 m wide around a block, with niches, posts and boxes as features for scan matching."""
    canvas = _Canvas((-3.4, 3.4), (-2.8, 2.8))
    # Inside the straight core the distance to the rounded rectangle is irrelevant: the block is there.
    canvas.free = abs(LOOP.distances(canvas)) < 1.2 / 2  # width of the corridor, m
    for niche in ((1.6, 2.2, 2.9, 2.45), (-1.3, 2.2, -0.4, 2.5), (-0.2, -2.6, 0.5, -2.2), (2.8, -0.5, 3.2, 0.2)):
        canvas.free |= canvas.rectangle(*niche)
    for corner in ((2.2, -2.25, 2.85, -1.6), (-2.85, -2.3, -2.2, -1.6), (-2.8, 1.6, -2.2, 2.2)):
        canvas.free |= canvas.rectangle(*corner)
    for box in ((-1.2, -2.4, -0.95, -2.18), (0.9, 2.18, 1.15, 2.4), (-3.0, 0.2, -2.78, 0.55), (1.0, -1.15, 1.3, -1.02)):
        canvas.free &= ~canvas.rectangle(*box)
    for post in ((-1.0, 1.1, 0.12), (1.75, 0.3, 0.08), (2.82, -1.1, 0.1)):
        canvas.free &= ~canvas.disc(*post)
    return BuiltIn(canvas.map(), (0.0, -LOOP.width / 2, 0.0))


def circuit() -> BuiltIn:
    """A track 2.2 m wide around a block, for fast robots, with niches, boxes and posts along its walls."""
    canvas = _Canvas((-6.2, 6.2), (-4.9, 4.9))
    canvas.free = abs(CIRCUIT.distances(canvas)) < 2.2 / 2  # width of the track, m
    for niche in ((2.0, 4.2, 2.8, 4.6), (-1.8, 4.2, -0.8, 4.7), (-0.4, -4.6, 0.6, -4.2), (5.5, -0.6, 5.9, 0.5)):
        canvas.free |= canvas.rectangle(*niche)
    for corner in ((4.3, -4.2, 5.4, -3.3), (-5.3, -4.1, -4.4, -3.2), (-5.4, 3.1, -4.5, 4.0)):
        canvas.free |= canvas.rectangle(*corner)
    for box in ((-2.4, -4.4, -2.1, -4.0), (1.5, 4.0, 1.8, 4.4), (-5.7, 0.3, -5.3, 0.8), (1.6, -2.3, 2.1, -2.0)):
        canvas.free &= ~canvas.rectangle(*box)
    for post in ((-1.5, 2.3, 0.15), (3.5, 0.4, 0.12), (5.45, -1.6, 0.15), (3.2, -4.2, 0.12)):
        canvas.free &= ~canvas.disc(*post)
    return BuiltIn(canvas.map(), (0.0, -CIRCUIT.width / 2, 0.0))


def rooms() -> BuiltIn:
    """Four rooms and a hall, doors 0.9 m wide, some furniture: 10 m x 8 m."""
    canvas = _Canvas((0.0, 10.0), (0.0, 8.0))
    for room in ((0.3, 0.3, 4.6, 3.0), (4.8, 0.3, 9.7, 3.0), (0.3, 4.9, 5.4, 7.7), (5.6, 4.9, 9.7, 7.7)):
        canvas.free |= canvas.rectangle(*room)
    canvas.free |= canvas.rectangle(0.3, 3.2, 9.7, 4.7)
    for door in ((2.0, 2.9, 2.9, 3.3), (7.2, 2.9, 8.1, 3.3), (3.4, 4.6, 4.3, 5.0), (6.4, 4.6, 7.3, 5.0)):
        canvas.free |= canvas.rectangle(*door)
    canvas.free |= canvas.rectangle(5.3, 6.2, 5.7, 7.1)
    for box in ((0.3, 0.3, 1.1, 0.9), (3.6, 1.8, 4.6, 2.3), (8.9, 0.3, 9.7, 1.5), (1.4, 6.3, 2.3, 6.9)):
        canvas.free &= ~canvas.rectangle(*box)
    for post in ((6.0, 1.6, 0.15), (8.2, 6.5, 0.3), (9.2, 4.0, 0.1)):
        canvas.free &= ~canvas.disc(*post)
    return BuiltIn(canvas.map(), (1.0, 3.95, 0.0))


def corridor_maze() -> BuiltIn:
    """Corridors 1.05 m wide on a 7 x 5 lattice of 1.4 m: a seeded tree with a few loops."""
    columns, rows, pitch, half = 7, 5, 1.4, 0.525
    canvas = _Canvas((-1.0, (columns - 1) * pitch + 1.0), (-1.0, (rows - 1) * pitch + 1.0))
    rng = np.random.default_rng(7)
    edges = [((c, r), (c + 1, r)) for c in range(columns - 1) for r in range(rows)]
    edges += [((c, r), (c, r + 1)) for c in range(columns) for r in range(rows - 1)]
    group = {(c, r): (c, r) for c in range(columns) for r in range(rows)}
    for index in rng.permutation(len(edges)):
        a, b = edges[index]
        if group[a] == group[b] and rng.random() > 0.2:
            continue
        merged, kept = group[a], group[b]
        group = {node: kept if root == merged else root for node, root in group.items()}
        canvas.free |= canvas.rectangle(
            a[0] * pitch - half, a[1] * pitch - half, b[0] * pitch + half, b[1] * pitch + half
        )
    return BuiltIn(canvas.map(), (0.0, 0.0, 0.0))


def ramp() -> BuiltIn:
    """A hall 9 m long: level, 8 degrees up, a landing, 12 degrees down, level."""
    canvas = _Canvas((-1.3, 8.3), (-1.5, 1.5))
    canvas.free = canvas.rectangle(-1.0, -1.2, 8.0, 1.2) & ~canvas.disc(3.9, 1.2, 0.25) & ~canvas.disc(6.6, -1.2, 0.2)
    up, down = 1.5 * tan(radians(8)), 1.0 * tan(radians(12))
    points = ((1.0, 0.0), (2.5, up), (4.5, up), (5.5, up - down), (6.0, up - down))
    return BuiltIn(canvas.map(), (0.0, 0.0, 0.0), Profile(tuple((x, round(z, 4)) for x, z in points)))


def yard() -> BuiltIn:
    """Open level floor, 7 m x 7 m, for calibration drives: a few posts and niches along the walls only."""
    canvas = _Canvas((-4.0, 4.0), (-4.0, 4.0))
    canvas.free = canvas.rectangle(-3.5, -3.5, 3.5, 3.5)
    for niche in ((3.4, -1.0, 3.8, 0.2), (-2.0, 3.4, -0.8, 3.75), (-3.7, 0.5, -3.4, 2.0)):
        canvas.free |= canvas.rectangle(*niche)
    for post in ((3.0, 2.6, 0.15), (-2.9, -2.4, 0.2), (0.8, -3.1, 0.12)):
        canvas.free &= ~canvas.disc(*post)
    return BuiltIn(canvas.map(), (0.0, 0.0, 0.0))


def hall() -> BuiltIn:
    """A hall, 11 m x 6 m, with posts and niches along its walls; the ground profile adds its contents."""
    canvas = _Canvas((-1.4, 10.4), (-3.5, 3.5))
    canvas.free = canvas.rectangle(-1.0, -3.0, 10.0, 3.0)
    for niche in ((0.5, 2.9, 1.4, 3.3), (6.0, 2.9, 6.5, 3.2), (3.0, -3.3, 4.2, -2.9), (9.9, -1.6, 10.3, -0.4)):
        canvas.free |= canvas.rectangle(*niche)
    for post in ((2.6, 2.8, 0.15), (8.2, 2.7, 0.2), (1.2, -2.8, 0.12), (6.8, -2.7, 0.2), (-0.8, 1.4, 0.1)):
        canvas.free &= ~canvas.disc(*post)
    return BuiltIn(canvas.map(), (0.0, 0.0, 0.0))


def workshop() -> BuiltIn:
    """A room, 5 m x 4 m, with a store behind a door of 1.1 m: small enough to be explored in a few minutes."""
    canvas = _Canvas((-2.4, 6.1), (-2.4, 2.4))
    canvas.free = canvas.rectangle(-2.0, -2.0, 3.0, 2.0) | canvas.rectangle(3.2, -1.5, 5.7, 1.5)
    canvas.free |= canvas.rectangle(2.9, -0.6, 3.3, 0.5)
    for niche in ((-1.2, 1.9, -0.5, 2.2), (0.6, -2.3, 1.5, -1.9), (4.2, 1.4, 4.8, 1.8)):
        canvas.free |= canvas.rectangle(*niche)
    for box in ((-2.0, -2.0, -1.5, -1.6), (2.6, 1.5, 3.0, 2.0), (5.3, -1.5, 5.7, -1.0)):
        canvas.free &= ~canvas.rectangle(*box)
    canvas.free &= ~canvas.disc(2.0, -1.85, 0.12)
    return BuiltIn(canvas.map(), (0.0, 0.0, 0.0))


def table() -> BuiltIn:
    """The flat top of a test stand with a rim all around; the origin is its centre."""
    half = 3.0 / 2  # side of the test stand's table, m
    canvas = _Canvas((-half - _WALL, half + _WALL), (-half - _WALL, half + _WALL))
    canvas.free |= canvas.rectangle(-half, -half, half, half)
    return BuiltIn(canvas.map(), (0.0, 0.0, 0.0))


BUILT_IN: dict[str, Callable[[], BuiltIn]] = {
    "loop": loop,
    "rooms": rooms,
    "corridor_maze": corridor_maze,
    "ramp": ramp,
    "yard": yard,
    "table": table,
    "hall": hall,
    "workshop": workshop,
    "circuit": circuit,
}


def lap(shape: RoundedRectangle = LOOP, spacing: float = 0.05) -> Array:
    """Return the lap of a world, counter-clockwise from its start pose and back to it.

    Args:
        shape: shape of the lap.
        spacing: approximate distance of the points (m); the actual one divides the lap evenly.

    Returns:
        (n, 3): x, y (m) and heading (rad, in (-pi, pi]) in the map frame; the last row repeats the first.
    """
    radius = shape.radius
    half_x, half_y = shape.length / 2 - radius, shape.width / 2 - radius
    arc = radius * pi / 2
    # (length, turn) of every piece, from the middle of the lower side.
    pieces = [(half_x, 0), (arc, 1), (2 * half_y, 0), (arc, 1), (2 * half_x, 0), (arc, 1), (2 * half_y, 0), (arc, 1)]
    pieces.append((half_x, 0))
    count = round(sum(length for length, _ in pieces) / spacing)
    stations = np.linspace(0.0, sum(length for length, _ in pieces), count + 1)
    points = np.empty((count + 1, 3))
    begun, x, y, yaw = 0.0, 0.0, -shape.width / 2, 0.0
    for length, turn in pieces:
        mine = (stations >= begun - 1e-9) & (stations <= begun + length + 1e-9)
        along = stations[mine] - begun
        points[mine] = np.stack(_along(x, y, yaw, along, turn / radius), axis=1)
        x, y, yaw = (float(v[0]) for v in _along(x, y, yaw, np.array([length]), turn / radius))
        begun += length
    points[:, 2] = pi - (pi - points[:, 2]) % (2 * pi)
    points[-1] = points[0]
    return points


def _along(x: float, y: float, yaw: float, s: Array, curvature: float) -> tuple[Array, Array, Array]:
    half = s * curvature / 2
    chord = s * np.sinc(half / pi)
    return x + chord * np.cos(yaw + half), y + chord * np.sin(yaw + half), yaw + 2 * half


def make_worlds(out: Path) -> list[Path]:
    """Write ``out``/worlds/NAME.yaml, .png, .profile.yaml and the laps in ``out``/paths; return the written files."""
    worlds, paths = out / "worlds", out / "paths"
    worlds.mkdir(parents=True, exist_ok=True)
    paths.mkdir(parents=True, exist_ok=True)
    written = []
    for name, draw in BUILT_IN.items():
        built, path = draw(), worlds / f"{name}.yaml"
        save_map(built.map, path)
        written += [path, path.with_suffix(".png")]
        if built.profile is not None:
            save_profile(built.profile, profile_path(path))
            written.append(profile_path(path))
    for name, shape in (("loop", LOOP), ("circuit", CIRCUIT)):
        rows = [f"{x:.4f},{y:.4f},{yaw:.5f},1" for x, y, yaw in lap(shape)]
        written.append(paths / f"{name}.csv")
        written[-1].write_text("\n".join(["x,y,yaw,direction", *rows, ""]), encoding="utf-8")
    return written


if __name__ == "__main__":
    for path in make_worlds(Path(sys.argv[1] if len(sys.argv) > 1 else "configs")):
        sys.stdout.write(f"{path}\n")
