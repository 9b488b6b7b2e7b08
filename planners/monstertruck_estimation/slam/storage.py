"""Saved maps: grid (map_server: ``map.yaml``, ``map.png``) and pose graph (``graph.npz``) of one save.

The graph file holds keyframes, their poses and edges as plain arrays, without pickles.
"""

import dataclasses
import hashlib
import io
import itertools
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from monstertruck_estimation.slam.correlation import RESOLUTION
from monstertruck_estimation.slam.keyframes import KeyframeMap
from monstertruck_estimation.slam.scans import SLIDE, Scan
from monstertruck_estimation.slam.worker_io import GridPatch
from monstertruck_kinematics.elementary import Array
from monstertruck_runtime.errors import InputError
from monstertruck_runtime.map_files import FREE, MOST_CELLS, OCCUPIED, WorldMap, load_map, load_saved, map_content
from monstertruck_runtime.map_folders import YAML, folder_of, opened, write_save
from monstertruck_runtime.outside import arrays as arrays_of
from monstertruck_runtime.outside import reading

GRAPH: Final = "graph.npz"
PICTURE: Final = "map.png"
VERSION: Final = 1
ELEMENTS: Final = tuple(field.name for field in dataclasses.fields(Scan))
"""Arrays of a scan; arrays missing in files of earlier versions are zeros."""
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
EDGES: Final = tuple(name for name in _SHAPES if name.startswith("edge_"))


@dataclass(frozen=True, slots=True)
class SavedGraph:
    """Keyframes and the edges between them."""

    stamps: NDArray[np.int64]
    """Stamps, shape (n,) (ns)."""
    poses: Array
    """Poses of base in map, shape (n, 3)."""
    scans: tuple[Scan, ...]
    """Scans in base."""
    edges: dict[str, NDArray[Any]]
    """``edge_*`` arrays of the file: ends (m, 2), measured (m, 3), information (m, 3, 3), spread (m, 2), loop (m,)."""


@dataclass(frozen=True, slots=True)
class SavedMap:
    """Content of a map folder."""

    grid: WorldMap
    graph: SavedGraph | None
    """Pose graph; None for a map of another program, which has only a grid."""


def elements(points: Array, **known: Array) -> Scan:
    """Return surface elements at ``points``, shape (n, 2), with zeros for unknown fields."""
    every = {name: known.get(name, np.zeros(len(points))) for name in ELEMENTS if name != "points"}
    return Scan(points=points, **every)


def saved_graph(known: KeyframeMap) -> SavedGraph:
    """Return the current graph for saving, without submaps that are not joined to its first keyframe."""
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


def g2o_text(graph: SavedGraph) -> str:
    """Return the graph as g2o text: ``VERTEX_SE2`` by keyframe number, the first one fixed, and ``EDGE_SE2``."""
    vertices = [f"VERTEX_SE2 {i} {x:.9g} {y:.9g} {yaw:.9g}" for i, (x, y, yaw) in enumerate(graph.poses.tolist())]
    corner = np.triu_indices(3)
    edges = [
        f"EDGE_SE2 {origin} {target} " + " ".join(f"{value:.9g}" for value in (*measured, *information[corner]))
        for (origin, target), measured, information in zip(
            graph.edges["edge_ends"].tolist(),
            graph.edges["edge_measured"].tolist(),
            graph.edges["edge_information"],
            strict=True,
        )
    ]
    return "\n".join([*vertices, "FIX 0", *edges, ""])


def trinary(patch: GridPatch) -> WorldMap:
    """Grey values of free, occupied and unknown cells."""
    return WorldMap(patch.cells, patch.resolution, patch.origin).trinary()


def save(folder: Path, patch: GridPatch, graph: SavedGraph | None, run: str = "") -> None:
    """Save a map.

    Args:
        folder: folder of the map.
        patch: the whole grid.
        graph: keyframes; None or empty: the grid alone.
        run: run that makes the map: other files it has saved here stay. An empty name makes this save a separate run.

    Raises:
        InputError: the map has no content to save.
        OSError: a file could not be written.
    """
    if not patch.cells.size:
        raise InputError(f"{folder}: the map is still empty")
    text, picture = map_content(trinary(patch), PICTURE)
    parts = {YAML: text.encode(), PICTURE: picture}
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
        parts[GRAPH] = data.getvalue()
    digest = hashlib.sha256(b"".join(parts.values())).hexdigest()
    write_save(folder, parts, (YAML, PICTURE, GRAPH), run or digest[:16])


def load(place: Path) -> SavedMap:
    """Read a saved map: its folder, or the YAML file of a map_server map.

    Raises:
        InputError: the map is invalid; the error names file, key and expected value.
    """
    folder = folder_of(place)
    if folder is None:
        return SavedMap(load_map(place).trinary(), None)
    with opened(folder) as found:
        grid, path = load_saved(found).trinary(), found.file(GRAPH)
        if not path.exists():
            return SavedMap(grid, None)
        try:
            return SavedMap(grid, _read_graph(path))
        except InputError as error:
            remarks = (*grid.remarks, f"{error}; the map is used without keyframes")
            return SavedMap(dataclasses.replace(grid, remarks=remarks), None)


def _read_graph(path: Path) -> SavedGraph:
    arrays = arrays_of(path, "a pose graph")
    with reading(path, "a pose graph"):
        return _graph_of(path, arrays)


def _graph_of(path: Path, arrays: dict[str, NDArray[Any]]) -> SavedGraph:
    version = arrays.get("version")
    if version is None or version.shape != () or version != VERSION:
        raise InputError(f"{path}: version: expected {VERSION}, got {version}")
    for name, shape in {**_SHAPES, "starts": ()}.items():
        if name not in arrays or arrays[name].shape[1:] != shape or arrays[name].ndim != len(shape) + 1:
            found = arrays[name].shape if name in arrays else "nothing"
            raise InputError(f"{path}: {name}: expected rows of shape {shape}, got {found}")
        if not np.isfinite(arrays[name]).all():
            raise InputError(f"{path}: {name}: expected finite numbers")
    starts, count = arrays["starts"].astype(np.int64), len(arrays["poses"])
    whole = len(starts) == count + 1 and starts[0] == 0 and (np.diff(starts) >= 0).all()
    if not whole or starts[-1] != len(arrays["points"]) or len(arrays["stamps"]) != count:
        raise InputError(f"{path}: starts: expected {count + 1} increasing numbers from 0 to {len(arrays['points'])}")
    every = {name: arrays[name].astype(np.float64) for name in ELEMENTS if name in arrays}
    edges = {name: values for name, values in arrays.items() if name in EDGES}
    for group in (every, edges):
        lengths = {name: len(values) for name, values in group.items()}
        if len(set(lengths.values())) > 1:
            raise InputError(f"{path}: expected rows of one number, got {lengths}")
    ends = edges["edge_ends"] = edges["edge_ends"].astype(np.int64)
    if ends.size and not (ends.min() >= 0 and ends.max() < count):
        raise InputError(f"{path}: edge_ends: expected numbers of {count} keyframes")
    if not (every["variances"] > 0.0).all():
        raise InputError(f"{path}: variances: expected numbers above 0")
    poses = arrays["poses"].astype(np.float64)
    _require_extent(path, every["points"], poses[np.repeat(np.arange(count), np.diff(starts))])
    scans = tuple(
        elements(**{name: values[a:b] for name, values in every.items()}) for a, b in itertools.pairwise(starts)
    )
    return SavedGraph(arrays["stamps"].astype(np.int64), poses, scans, edges)


def _require_extent(path: Path, points: Array, poses: Array) -> None:
    """Refuse surfaces too far apart for a grid.

    Args:
        path: source file, for the error.
        points: points in base, shape (n, 2).
        poses: poses of the base in map for each point, shape (n, 3).

    Raises:
        InputError: a grid of the points would exceed ``MOST_CELLS``.
    """
    if not len(points):
        return
    cos, sin = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    x = poses[:, 0] + cos * points[:, 0] - sin * points[:, 1]
    y = poses[:, 1] + sin * points[:, 0] + cos * points[:, 1]
    width, height = float(np.ptp(x)), float(np.ptp(y))
    if (width / RESOLUTION + 1.0) * (height / RESOLUTION + 1.0) > MOST_CELLS:
        raise InputError(f"{path}: surfaces over {width:g} m x {height:g} m: expected at most {MOST_CELLS} cells")


def surface_elements(grid: WorldMap) -> Scan:
    """Return surface elements in map of all walls next to free cells."""
    step = grid.resolution
    cells, towards = _faces(grid.cells)
    if not len(cells):
        return elements(np.zeros((0, 2)), normals=np.zeros((0, 2)), variances=np.zeros((0, 2)))
    normal_reach = 0.2  # maximum distance of faces used for a normal, m
    normal_cells = 4.0  # minimum reach in cells, to average the steps of an oblique wall
    normals, straight, aside = _fitted(cells, towards, max(normal_reach / step, normal_cells))
    # The centre of a free cell next to a wall is one cell from the centre of the wall's cell.
    points = (cells + aside - normals + 0.5) * step + np.array(grid.origin)
    across = 0.02**2 + step**2 / 12  # minimum standard deviation of a drawn wall, m
    variances = np.stack((np.full(len(points), across), np.where(straight, SLIDE**2, across)), axis=-1)
    return elements(points, normals=normals, variances=variances, extents=np.where(straight, step / 2, 0.0))


def _faces(cells: NDArray[np.int8]) -> tuple[Array, Array]:
    """Return free cells next to an occupied one (column, row), shape (n, 2), and unit vectors away from the wall."""
    wall = np.pad(cells == OCCUPIED, 1).astype(np.float64)
    rows, columns = cells.shape

    def neighbour(dx: int, dy: int) -> Array:
        return wall[1 + dy : 1 + dy + rows, 1 + dx : 1 + dx + columns]

    touching = neighbour(1, 0) + neighbour(-1, 0) + neighbour(0, 1) + neighbour(0, -1) > 0

    def slope(dx: int, dy: int) -> Array:
        return neighbour(-dx, -dy) - neighbour(dx, dy)

    # Sobel kernel: estimates the rough direction of an oblique wall from its stairs.
    x = 2 * slope(1, 0) + slope(1, 1) + slope(1, -1)
    y = 2 * slope(0, 1) + slope(1, 1) + slope(-1, 1)
    length = np.hypot(x, y)
    # In a gap one cell wide both sides cancel; such cells are left out.
    at = np.nonzero((cells == FREE) & touching & (length > 0))
    free: Array = np.stack(at[::-1], axis=-1).astype(np.float64)
    return free, np.stack((x[at], y[at]), axis=-1) / length[at][:, None]


def _fitted(cells: Array, towards: Array, reach: float) -> tuple[Array, NDArray[np.bool_], Array]:
    """Fit lines to nearby faces; return normals (n, 2), whether each is a line, and steps (n, 2) onto the lines."""
    count = len(cells)
    first, second = cKDTree(cells).query_pairs(reach, output_type="ndarray").T
    here = np.concatenate((first, second, np.arange(count)))
    there = np.concatenate((second, first, np.arange(count)))
    normal_agreement = 0.5  # minimum cosine between initial normals on one side of one wall
    same = (towards[here] * towards[there]).sum(axis=1) > normal_agreement
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
    straightness = 0.1  # maximum ratio of the variances across and along a line of faces
    straight = (near >= 3) & (middle - half < straightness * (middle + half))
    angle = 0.5 * np.arctan2(2 * cxy, cxx - cyy)
    normals = np.stack((-np.sin(angle), np.cos(angle)), axis=-1)
    normals *= np.where((normals * towards).sum(axis=1) < 0, -1.0, 1.0)[:, None]
    normals = np.where(straight[:, None], normals, towards)
    across = normals[:, 0] * mx + normals[:, 1] * my
    return normals, straight, np.where(straight, across, 0.0)[:, None] * normals
