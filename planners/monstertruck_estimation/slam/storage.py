"""Saved maps: a folder with the grid (map_server: ``map.yaml``, ``map.png``) and the pose graph (``graph.npz``).

The graph holds keyframes, their poses and the edges between them as plain arrays, no pickles. Every file is replaced
atomically, the YAML last.
"""

import dataclasses
import io
import itertools
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from monstertruck_estimation.slam.keyframes import KeyframeMap
from monstertruck_estimation.slam.scans import SLIDE, Scan
from monstertruck_estimation.slam.worker_io import GridPatch
from monstertruck_kinematics.elementary import Array
from monstertruck_runtime.errors import InputError
from monstertruck_runtime.map_files import FREE, OCCUPIED, YAML, WorldMap, load_map, save_map
from monstertruck_runtime.small_files import replace_file

GRAPH: Final = "graph.npz"
VERSION: Final = 1
ELEMENTS: Final = tuple(field.name for field in dataclasses.fields(Scan))
"""Arrays of a scan: of a file that was written before there were so many, the others are zeros."""
_SHAPES: Final[dict[str, tuple[int, ...]]] = {
    "stamps": (),
    "poses": (3,),
    "points": (2,),
    "normals": (2,),
    "variances": (2,),
    "edge_ends": (2,),
    "edge_measured": (3,),
    "edge_information": (3, 3),
    "edge_spread": (2,),
    "edge_loop": (),
}


@dataclass(frozen=True, slots=True)
class SavedGraph:
    """Keyframes and the edges between them."""

    stamps: NDArray[np.int64]
    """Shape (n,), ns."""
    poses: Array
    """Shape (n, 3), base in map."""
    scans: tuple[Scan, ...]
    """In base."""
    edges: dict[str, NDArray[Any]]
    """``edge_*`` arrays of the file: ends (m, 2), measured (m, 3), information (m, 3, 3), spread (m, 2), loop (m,)."""


@dataclass(frozen=True, slots=True)
class SavedMap:
    """What a folder holds."""

    grid: WorldMap
    graph: SavedGraph | None
    """None for a map of another program: grid only."""


def elements(points: Array, **known: Array) -> Scan:
    """Surface elements at ``points``, shape (n, 2); of what is not known of them, zeros."""
    every = {name: known.get(name, np.zeros(len(points))) for name in ELEMENTS if name != "points"}
    return Scan(points=points, **every)


def saved_graph(known: KeyframeMap) -> SavedGraph:
    """The graph as it is, to be saved, without submaps that are not joined to its first keyframe."""
    kept = known.joined()
    edges = known.edges.edges()
    inside = kept[edges.origin]
    edges = edges.chosen(inside).renumbered(np.cumsum(kept) - 1)
    frames = [key for key, one in zip(known.frames, kept.tolist(), strict=True) if one]
    return SavedGraph(
        np.array([key.stamp for key in frames], np.int64),
        known.poses[kept],
        tuple(key.scan for key in frames),
        {
            "edge_ends": np.stack((edges.origin, edges.target), axis=-1),
            "edge_measured": np.array(edges.measured),
            "edge_information": np.array(edges.information),
            "edge_spread": np.array(known.edges.spread[inside]),
            "edge_loop": np.array(edges.loop),
        },
    )


def trinary(patch: GridPatch) -> WorldMap:
    """Free, occupied, unknown."""
    return WorldMap(patch.cells, patch.resolution, patch.origin).trinary()


def save(folder: Path, patch: GridPatch, graph: SavedGraph | None) -> None:
    """Write a map.

    Raises:
        InputError: there is nothing to save yet.
        OSError: a file could not be written.
    """
    if not patch.cells.size:
        raise InputError(f"{folder}: nothing is mapped yet")
    folder.mkdir(parents=True, exist_ok=True)
    if graph is not None and graph.scans:
        counts = [len(scan) for scan in graph.scans]
        every: dict[str, Any] = {
            name: np.concatenate([getattr(scan, name) for scan in graph.scans]).astype(np.float32) for name in ELEMENTS
        }
        every |= graph.edges
        data = io.BytesIO()
        np.savez_compressed(
            data,
            version=np.array(VERSION),
            stamps=graph.stamps,
            poses=graph.poses,
            starts=np.concatenate(([0], np.cumsum(counts, dtype=np.int64))),
            **every,
        )
        replace_file(folder / GRAPH, data.getvalue())
    save_map(trinary(patch), folder / YAML)


def load(place: Path) -> SavedMap:
    """Read a saved map: its folder, or the YAML file of a map_server map.

    Raises:
        InputError: file, key and expectation of whatever is wrong.
    """
    if not place.is_dir():
        return SavedMap(load_map(place).trinary(), None)
    graph = place / GRAPH
    return SavedMap(load_map(place / YAML).trinary(), _read_graph(graph) if graph.exists() else None)


def _read_graph(path: Path) -> SavedGraph:
    try:
        with np.load(io.BytesIO(path.read_bytes()), allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
    except (OSError, ValueError, EOFError, zipfile.BadZipFile) as error:
        raise InputError(f"{path}: not a graph: {error}") from error
    if arrays.get("version") is None or int(arrays["version"]) != VERSION:
        raise InputError(f"{path}: version: expected {VERSION}, got {arrays.get('version')}")
    for name, shape in {**_SHAPES, "starts": ()}.items():
        if name not in arrays or arrays[name].shape[1:] != shape or arrays[name].ndim != len(shape) + 1:
            found = arrays[name].shape if name in arrays else "nothing"
            raise InputError(f"{path}: {name}: expected rows of shape {shape}, got {found}")
    starts, count = arrays["starts"], len(arrays["poses"])
    whole = len(starts) == count + 1 and starts[0] == 0 and (np.diff(starts) >= 0).all()
    if not whole or starts[-1] != len(arrays["points"]) or len(arrays["stamps"]) != count:
        raise InputError(f"{path}: starts: expected {count + 1} rising numbers from 0 to {len(arrays['points'])}")
    every = {name: arrays[name].astype(np.float64) for name in ELEMENTS if name in arrays}
    scans = tuple(
        elements(**{name: values[a:b] for name, values in every.items()}) for a, b in itertools.pairwise(starts)
    )
    edges = {name: values for name, values in arrays.items() if name.startswith("edge_")}
    return SavedGraph(arrays["stamps"], arrays["poses"], scans, edges)


NORMAL_REACH: Final = 0.2
"""Faces up to this far away make the normal, m; at least ``NORMAL_CELLS``."""
NORMAL_CELLS: Final = 4.0
"""Least reach in cells: the steps of an oblique wall must be averaged."""
NORMAL_AGREEMENT: Final = 0.5
"""Cosine between first guesses of normals that may belong to one side of one wall."""
STRAIGHTNESS: Final = 0.1
"""Faces lie on a line if they spread across it by less than this part of the variance along it."""
WALL_NOISE: Final = 0.02
"""Least standard deviation of a drawn wall, m."""


def surface_elements(grid: WorldMap) -> Scan:
    """Surface elements in map of all walls next to free cells."""
    step = grid.resolution
    cells, towards = _faces(grid.cells)
    if not len(cells):
        return elements(np.zeros((0, 2)), normals=np.zeros((0, 2)), variances=np.zeros((0, 2)))
    normals, straight, aside = _fitted(cells, towards, max(NORMAL_REACH / step, NORMAL_CELLS))
    # A free cell next to a wall is one cell from the middle of the wall's cells.
    points = (cells + aside - normals + 0.5) * step + np.array(grid.origin)
    across = WALL_NOISE**2 + step**2 / 12
    variances = np.stack((np.full(len(points), across), np.where(straight, SLIDE**2, across)), axis=-1)
    return elements(points, normals=normals, variances=variances, extents=np.where(straight, step / 2, 0.0))


def _faces(cells: NDArray[np.int8]) -> tuple[Array, Array]:
    """Free cells that share an edge with an occupied one (column, row), shape (n, 2); unit vectors away from those."""
    wall = np.pad(cells == OCCUPIED, 1).astype(np.float64)
    rows, columns = cells.shape

    def neighbour(dx: int, dy: int) -> Array:
        return wall[1 + dy : 1 + dy + rows, 1 + dx : 1 + dx + columns]

    touching = neighbour(1, 0) + neighbour(-1, 0) + neighbour(0, 1) + neighbour(0, -1) > 0

    def slope(dx: int, dy: int) -> Array:
        return neighbour(-dx, -dy) - neighbour(dx, dy)

    # Sobel's kernel: the stairs of an oblique wall give its direction roughly.
    x = 2 * slope(1, 0) + slope(1, 1) + slope(1, -1)
    y = 2 * slope(0, 1) + slope(1, 1) + slope(-1, 1)
    length = np.hypot(x, y)
    # In a gap one cell wide both sides cancel; it is left out.
    at = np.nonzero((cells == FREE) & touching & (length > 0))
    free: Array = np.stack(at[::-1], axis=-1).astype(np.float64)
    return free, np.stack((x[at], y[at]), axis=-1) / length[at][:, None]


def _fitted(cells: Array, towards: Array, reach: float) -> tuple[Array, NDArray[np.bool_], Array]:
    """Normals, shape (n, 2), of lines through the faces near each; whether those are lines; steps (n, 2) onto them."""
    count = len(cells)
    first, second = cKDTree(cells).query_pairs(reach, output_type="ndarray").T
    here = np.concatenate((first, second, np.arange(count)))
    there = np.concatenate((second, first, np.arange(count)))
    same = (towards[here] * towards[there]).sum(axis=1) > NORMAL_AGREEMENT
    here, there = here[same], there[same]

    def total(values: Array) -> Array:
        summed: Array = np.bincount(here, values, count).astype(np.float64)
        return summed

    off, near = cells[there] - cells[here], total(np.ones(len(here)))
    mx, my = total(off[:, 0]) / near, total(off[:, 1]) / near
    cxx = total(off[:, 0] ** 2) / near - mx * mx
    cyy = total(off[:, 1] ** 2) / near - my * my
    cxy = total(off[:, 0] * off[:, 1]) / near - mx * my
    middle, half = (cxx + cyy) / 2, np.hypot((cxx - cyy) / 2, cxy)
    straight = (near >= 3) & (middle - half < STRAIGHTNESS * (middle + half))
    angle = 0.5 * np.arctan2(2 * cxy, cxx - cyy)
    normals = np.stack((-np.sin(angle), np.cos(angle)), axis=-1)
    normals *= np.where((normals * towards).sum(axis=1) < 0, -1.0, 1.0)[:, None]
    normals = np.where(straight[:, None], normals, towards)
    across = normals[:, 0] * mx + normals[:, 1] * my
    return normals, straight, np.where(straight, across, 0.0)[:, None] * normals
