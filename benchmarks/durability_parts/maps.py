"""Saved maps: grid, graph, ground and points of interest of several runs in one folder."""

import random
from collections.abc import Iterator
from pathlib import Path
from typing import Final

import numpy as np

from benchmarks.durability_parts.subject import Death, Subject
from monstertruck_estimation.ground.grid import GROUND_RESOLUTION, GroundGrid
from monstertruck_estimation.points import files
from monstertruck_estimation.slam import storage
from monstertruck_estimation.slam.worker_io import GridPatch
from monstertruck_runtime.map_folders import tidy
from monstertruck_schemas.points import PointKind, PointOfInterest

SAVES: Final = 8
"""Saves of one run."""
KEYS: Final = 40
"""Keyframes of a map."""
Part = tuple[str, int, int]
"""What was saved: grid, ground or points, the run, and the number of the save."""


def write(folder: Path, seed: int) -> Iterator[str]:
    """Save maps run after run; every part contains the numbers of its run and its save.

    Points saved before the grid of their run are acknowledged once the grid is saved as well.
    """
    rng, place, number, mapped = random.Random(seed), folder / "map", 0, -1
    while True:
        run = number // SAVES
        for part in rng.choices(("grid", "ground", "points"), (3, 1, 2), k=SAVES):
            number += 1
            if part == "ground":
                _ground(run, number).save(place, str(run))
            elif part == "points":
                files.save(place, _points(run, number), str(run))
            if part == "grid" or (part == "points" and mapped != run):
                storage.save(place, _patch(run, number), _graph(run, number), str(run))
                mapped = run
            yield f"{part} {run} {number}"


def check(folder: Path, acknowledged: list[str], death: Death) -> str | None:
    """Load as at the next start: all parts must be of one run, each at least as new as acknowledged."""
    place, parts = folder / "map", [_part(line) for line in acknowledged]
    tidy(place)
    if left := [path.name for path in place.glob("saves/*") if not path.name.isdecimal()]:
        return f"left behind: {left}"
    if all(name == "ground" for name, _, _ in parts):
        return None  # nothing can be read without a grid
    saved = storage.load(place)
    if saved.grid.remarks:
        return f"damaged: {saved.grid.remarks[0]}"
    found: dict[str, tuple[int, int]] = {"grid": _numbers(*saved.grid.origin)}
    if saved.graph is None:
        return "no graph"
    if any(_numbers(*pose[:2]) != found["grid"] for pose in saved.graph.poses.tolist()):
        return f"grid {found['grid']} with a graph of another save"
    ground = GroundGrid.load(place)
    if not ground.empty:
        origin = ground.message(0, 0, "map").origin
        found["ground"] = _numbers(origin.x / GROUND_RESOLUTION, origin.y / GROUND_RESOLUTION)
    for point, picture in files.load(place):
        found["points"] = _numbers(point.x, point.y)
        if picture.split() != [b"%d" % value for value in found["points"]]:
            return f"points {found['points']} with the picture {picture!r}"
    return _compare(found, parts)


def _compare(found: dict[str, tuple[int, int]], parts: list[Part]) -> str | None:
    run = found["grid"][0]
    if mixed := {name: numbers for name, numbers in found.items() if numbers[0] != run}:
        return f"mixed: grid of run {run} with {mixed}"
    if run < max(made for name, made, _ in parts if name != "ground"):
        return f"an older run's map: {run}"
    for name in ("grid", "ground", "points"):
        newest = max((number for part, made, number in parts if (part, made) == (name, run)), default=0)
        if newest and found.get(name, (run, 0))[1] < newest:
            return f"lost: {name} of save {newest}, found {found.get(name)}"
    return None


def _part(line: str) -> Part:
    name, run, number = line.split()
    return name, int(run), int(number)


def _numbers(run: float, number: float) -> tuple[int, int]:
    return round(run), round(number)


def _patch(run: int, number: int) -> GridPatch:
    cells = np.random.default_rng(number).choice(np.array((-1, 0, 100), np.int8), (60, 80))
    return GridPatch(cells, (float(run), float(number)), 0.05)


def _graph(run: int, number: int) -> storage.SavedGraph:
    rng, none = np.random.default_rng(number), np.zeros(0)
    normals, variances = np.tile((0.0, 1.0), (20, 1)), np.full((20, 2), 1e-4)
    scans = tuple(storage.elements(rng.normal(size=(20, 2)), normals=normals, variances=variances) for _ in range(KEYS))
    edges = {
        "edge_ends": np.zeros((0, 2), np.int64),
        "edge_measured": np.zeros((0, 3)),
        "edge_information": np.zeros((0, 3, 3)),
        "edge_spread": np.zeros((0, 2)),
        "edge_loop": none,
    }
    return storage.SavedGraph(np.arange(KEYS), np.tile((float(run), float(number), 0.0), (KEYS, 1)), scans, edges)


def _ground(run: int, number: int) -> GroundGrid:
    grid = GroundGrid()
    grid.observe(np.array([((run + 0.5) * GROUND_RESOLUTION, (number + 0.5) * GROUND_RESOLUTION)]), 0.1, 0.0)
    return grid


def _points(run: int, number: int) -> list[tuple[PointOfInterest, bytes]]:
    point = PointOfInterest(
        name="tag-1", kind=PointKind.TAG, tag=1, x=float(run), y=float(number), yaw=0.0,
        covariance=np.diag((0.01, 0.01, 0.01)).ravel(), first=1, last=2, picture=True,
    )  # fmt: skip
    return [(point, b"%d %d" % (run, number))]


SUBJECT: Final = Subject("maps", write, check, seconds=0.6, changes=24)
