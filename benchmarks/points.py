"""Points of interest: tags on the walls of built-in worlds, read from pictures of a drive; by plane and in 3D.

    python benchmarks/points.py [--seeds 3] [--metres 40] [--part all|light|daemon]

``light``: no daemon. Twenty tags of 10 cm hang on walls drawn by the seed; a camera with distortion and noise is
carried along a drive of the truck's speed and looks at a wall here and there. The pose that goes with a picture is the
true one with a slow error (15 mm, 0.4 degrees: those of the mapper over minutes). Tags that came within 1.5 m and 45
degrees of the camera, whole in the picture and not hidden, are to be found; which did is judged by the world's truth.

``daemon``: the whole truck on the virtual clock, mapping ``configs/points.yaml`` with ``explore --find``.

The last line is JSON.
"""

import argparse
import json
import math
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from scipy.ndimage import distance_transform_edt
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import dijkstra

from benchmarks import ROOT
from monstertruck_drivers.webcam.emulator import jpeg
from monstertruck_estimation.points.config import PointsConfig
from monstertruck_estimation.points.exchange import ReadTask
from monstertruck_estimation.points.reader import ReadingStep
from monstertruck_estimation.points.tracking import PointMap
from monstertruck_runtime.clock import SECOND, VirtualClock, run_virtual
from monstertruck_runtime.errors import NotInstalledError
from monstertruck_runtime.mailbox import latest
from monstertruck_runtime.map_files import FREE, OCCUPIED
from monstertruck_schemas import topics
from monstertruck_schemas.body import LensConfig, Mount
from monstertruck_sim.world.camera import mounted
from monstertruck_sim.world.config import CameraConfig, TagConfig, WorldConfig
from monstertruck_sim.world.world import World
from monstertruckd.config.load import load_config
from monstertruckd.tools.simulation.config import SimulatedTruckConfig, with_overlay
from monstertruckd.tools.simulation.operator import LocalOperator
from monstertruckd.tools.simulation.virtual_rig import VirtualRig

OUTPUT = ROOT / "runs" / "benchmarks" / "points.json"
GOALS = {"recall": 0.95, "false": 0, "position_p95_mm": 50.0}
WORLDS = ("rooms", "corridor_maze")
SIZE = (640, 480)
COUNT, SPACING = 20, 0.7
REACH, OBLIQUE = 1.5, math.radians(45.0)
RATE, SPEED, TURNING = 5.0, 0.2, 0.6
"""Pictures a second, m/s, rad/s."""
CLEAR = 0.34
"""Metres from walls at which the truck may stand anyhow."""
SIGMA, SIGMA_YAW, SLOW = 0.015, math.radians(0.4), 20.0
"""Standard deviations of the pose error (m, rad) and its time constant, s."""
LENS: dict[str, Any] = {"k1": -0.12, "k2": 0.02}
Pose = tuple[float, float, float]


@dataclass
class Score:
    """Score of one drive, or of several together."""

    near: int = 0
    """Tags that came near enough."""
    found: int = 0
    """Number of them that were found."""
    false: int = 0
    known: int = 0
    errors: list[float] = field(default_factory=list)
    yaw_errors: list[float] = field(default_factory=list)
    pictures: int = 0
    read_ms: list[float] = field(default_factory=list)

    def add(self, other: "Score") -> None:
        """Add another drive's figures."""
        for name, value in vars(other).items():
            setattr(self, name, getattr(self, name) + value)

    def figures(self) -> dict[str, Any]:
        """Return the reported figures."""
        return {
            "near": self.near,
            "recall": self.found / max(self.near, 1),
            "false": self.false,
            "known": self.known,
            "position_p50_mm": 1e3 * float(np.quantile(self.errors, 0.5)) if self.errors else None,
            "position_p95_mm": 1e3 * float(np.quantile(self.errors, 0.95)) if self.errors else None,
            "yaw_p95_deg": math.degrees(float(np.quantile(self.yaw_errors, 0.95))) if self.yaw_errors else None,
            "pictures": self.pictures,
            "read_p95_ms": float(np.quantile(self.read_ms, 0.95)) if self.read_ms else None,
        }


# Worlds


def tags_on_walls(name: str, rng: np.random.Generator) -> tuple[TagConfig, ...]:
    """Return tags at random places of a built-in world's straight walls with 0.7 m of free space in front."""
    world = World(WorldConfig(map=name), 1)
    cells, step, origin = world.map.cells, world.map.resolution, world.map.origin
    ahead, wide = round(0.7 / step), round(0.075 / step)
    found: list[TagConfig] = []
    for at in rng.permutation(cells.size):
        row, column = divmod(int(at), cells.shape[1])
        if cells[row, column] != OCCUPIED or len(found) == COUNT:
            continue
        for dx, dy in ((1, 0), (-1, 0), (0, 1), (0, -1)):
            sides = [(row + dx * k, column + dy * k) for k in range(-wide, wide + 1)]
            front = [(row + dy * k, column + dx * k) for k in range(1, ahead)]
            inside = all(0 <= r < cells.shape[0] and 0 <= c < cells.shape[1] for r, c in (*sides, *front))
            if not inside or any(cells[cell] != OCCUPIED for cell in sides) or any(cells[c] != FREE for c in front):
                continue
            if any(cells[r + dy, c + dx] != FREE for r, c in sides):
                continue
            x = origin[0] + (column + 0.5 + dx * 0.5) * step + dx * 0.004
            y = origin[1] + (row + 0.5 + dy * 0.5) * step + dy * 0.004
            if all(math.hypot(x - tag.x, y - tag.y) > SPACING for tag in found):
                number = int(rng.integers(0, 587))
                z = float(rng.uniform(0.15, 0.4))
                if all(tag.tag != number for tag in found):
                    found.append(TagConfig(tag=number, x=x, y=y, z=z, yaw=math.atan2(dy, dx)))
            break
    return tuple(found)


def world_of(name: str, engine: Any, tags: tuple[TagConfig, ...], seed: int) -> World:
    """Return the world with the tags, and a camera with distortion and noise."""
    camera = CameraConfig(noise=3.0, rendered=engine == "mujoco", **LENS)
    return World(WorldConfig(map=name, engine=engine, tags=tags, camera=camera), seed)


def drive(world: World, rng: np.random.Generator, metres: float) -> Iterator[Pose]:
    """Yield poses at the rate of the images: from place to place, turning to the nearest wall at each."""
    cells, step, origin = world.map.cells, world.map.resolution, world.map.origin
    away, nearest = distance_transform_edt(cells == FREE, return_indices=True)
    coarse = max(1, round(0.1 / step))
    free = (away * step > CLEAR)[::coarse, ::coarse]
    graph = _graph(free)
    start = world.plant.pose
    here = _node(free, start, step * coarse, origin)
    reached = np.isfinite(dijkstra(graph, indices=here))
    nodes = np.flatnonzero(free.ravel() & reached)
    yaw, driven = start[2], 0.0
    while driven < metres:
        goal = int(rng.choice(nodes))
        _, before = dijkstra(graph, indices=here, return_predecessors=True)
        way = [goal]
        while way[-1] != here and before[way[-1]] >= 0:
            way.append(int(before[way[-1]]))
        points = np.array([_place(node, free.shape[1], step * coarse, origin) for node in reversed(way)])
        along = np.append(0.0, np.cumsum(np.hypot(*np.diff(points, axis=0).T))) if len(points) > 1 else np.zeros(1)
        for s in np.arange(0.0, along[-1], SPEED / RATE):
            x, y = (float(np.interp(s, along, points[:, k])) for k in (0, 1))
            tx, ty = (float(np.interp(s + 0.3, along, points[:, k])) for k in (0, 1))
            yaw = _turned(yaw, math.atan2(ty - y, tx - x))
            yield x, y, yaw
        driven += float(along[-1])
        x, y = points[-1].tolist()
        row, column = (round((v - o) / step - 0.5) for v, o in ((y, origin[1]), (x, origin[0])))
        r, c = nearest[0][row, column], nearest[1][row, column]
        wall = math.atan2((r - row), (c - column))
        while abs(math.remainder(wall - yaw, math.tau)) > 0.02:
            yaw = _turned(yaw, wall)
            yield x, y, yaw
        here = goal


def _turned(yaw: float, towards: float) -> float:
    most = TURNING / RATE
    return yaw + min(max(math.remainder(towards - yaw, math.tau), -most), most)


def _graph(free: np.ndarray) -> coo_matrix:
    numbers = np.arange(free.size).reshape(free.shape)
    ends = []
    for dy, dx in ((0, 1), (1, 0), (1, 1), (1, -1)):
        a = numbers[: free.shape[0] - dy, max(0, -dx) : free.shape[1] - max(0, dx)]
        b = numbers[dy:, max(0, dx) : free.shape[1] + min(0, dx)]
        both = free.ravel()[a] & free.ravel()[b]
        ends.append((a[both], b[both], np.full(int(both.sum()), math.hypot(dx, dy))))
    one, other, cost = (np.concatenate(part) for part in zip(*ends, strict=True))
    ends_ = (np.concatenate((one, other)), np.concatenate((other, one)))
    return coo_matrix((np.concatenate((cost, cost)), ends_), (free.size, free.size)).tocsr()


def _node(free: np.ndarray, pose: Any, cell: float, origin: tuple[float, float]) -> int:
    rows, columns = np.nonzero(free)
    x, y = origin[0] + columns * cell, origin[1] + rows * cell
    k = int(np.argmin(np.hypot(x - pose[0], y - pose[1])))
    return int(rows[k] * free.shape[1] + columns[k])


def _place(node: int, width: int, cell: float, origin: tuple[float, float]) -> tuple[float, float]:
    row, column = divmod(node, width)
    return origin[0] + column * cell + cell / 4, origin[1] + row * cell + cell / 4


# Light


def near_tags(world: World, pose: Pose, tags: tuple[TagConfig, ...]) -> set[int]:
    """Return the tags near enough, not too oblique, whole in the image and not hidden, by the world's truth."""
    camera = world.view.config
    place = mounted(pose, camera)
    focal = SIZE[0] / 2 / math.tan(camera.field_of_view / 2)
    found = set()
    for tag in tags:
        middle = np.array((tag.x, tag.y, tag.z))
        off = middle - place.centre
        far = float(np.linalg.norm(off))
        normal = np.array((math.cos(tag.yaw), math.sin(tag.yaw), 0.0))
        if far > REACH or -off @ normal < far * math.cos(OBLIQUE):
            continue
        side = np.array((-math.sin(tag.yaw), math.cos(tag.yaw), 0.0)) * tag.size * 0.625
        up = np.array((0.0, 0.0, tag.size * 0.625))
        corners = [middle + a * side + b * up for a in (-1, 1) for b in (-1, 1)]
        seen = (np.array(corners) - place.centre) @ place.axes.T
        if (seen[:, 2] < 0.1).any():
            continue
        flat = seen[:, :2] / seen[:, 2:]
        square = (flat**2).sum(axis=1, keepdims=True)
        pixels = np.abs(flat * (1 + camera.k1 * square + camera.k2 * square**2)) * focal
        if (pixels > (SIZE[0] / 2 - 3, SIZE[1] / 2 - 3)).any():
            continue
        level = [corner - place.centre for corner in corners]
        angles = np.array([math.atan2(v[1], v[0]) for v in level])
        origin = np.full(4, place.centre[0]), np.full(4, place.centre[1])
        ranges = world.scene.cast(*origin, angles, 10.0, without=world.name)
        if all(r > math.hypot(v[0], v[1]) - 0.04 for r, v in zip(ranges, level, strict=True)):
            found.add(tag.tag)
    return found


def light(name: str, engine: str, seed: int, metres: float) -> Score:
    """Run one drive."""
    rng = np.random.default_rng(seed)
    tags = tags_on_walls(name, rng)
    world, score = world_of(name, engine, tags, seed), Score()
    config, mount, lens = PointsConfig(), Mount(x=0.18, z=0.25), LensConfig(**LENS)
    step, points = ReadingStep(), PointMap(config, mount)
    keep = math.exp(-1 / RATE / SLOW)
    error = rng.standard_normal(3)
    spread = np.diag((SIGMA**2, SIGMA**2, SIGMA_YAW**2))
    near: set[int] = set()
    before: Pose | None = None
    for number, pose in enumerate(drive(world, rng, metres)):
        at = SECOND + round(number / RATE * SECOND)
        world.carry(at, pose)
        picture = jpeg(world.view.exposure(at, SIZE)(), number)
        near |= near_tags(world, pose, tags)
        error = keep * error + math.sqrt(1 - keep**2) * rng.standard_normal(3)
        x, y, yaw = (float(v) for v in np.array(pose) + error * (SIGMA, SIGMA, SIGMA_YAW))
        rate = 0.0 if before is None else math.remainder(pose[2] - before[2], math.tau) * RATE
        before = pose
        begin = time.process_time()
        answer = step.step(ReadTask.of(picture, lens, config))
        score.read_ms.append(1e3 * (time.process_time() - begin))
        score.pictures += 1
        for reading in answer.readings:
            points.see(reading, at, (x, y, yaw), spread, rate)
    for point in list(points.points):
        points.refresh(point, {})
    judge(score, points.shown.values(), tags, near)
    return score


def judge(score: Score, points: Any, tags: tuple[TagConfig, ...], near: set[int]) -> None:
    """Compare the points with the truth."""
    true = {tag.tag: tag for tag in tags}
    found = set()
    for point in points:
        tag = true.get(point.tag)
        off = math.inf if tag is None else math.hypot(point.x - tag.x, point.y - tag.y)
        score.known += 1
        if tag is None or off > 0.5:
            score.false += 1
            continue
        found.add(tag.tag)
        score.errors.append(off)
        score.yaw_errors.append(abs(math.remainder(point.yaw - tag.yaw, math.tau)))
    score.near += len(near)
    score.found += len(near & found)
    missed = near - found
    if missed:
        print(f"  missed: {sorted(missed)}", flush=True)


# The whole daemon


def daemon(seed: int, limit: float = 900.0) -> dict[str, Any]:
    """Run ``configs/points.yaml``: the truck maps, explores and finds all six tags."""
    config = load_config(ROOT / "configs" / "points.yaml", SimulatedTruckConfig)[0]
    score = Score()
    with TemporaryDirectory() as folder:
        overlay = {"recorder": None, "blackbox": None, "slam": {"save": Path(folder) / "map"}, "sim": {"seed": seed}}
        config = with_overlay(config, overlay)
        tags = config.sim.world.tags

        async def main(clock: VirtualClock) -> dict[str, Any]:
            rig, begin = VirtualRig(config, clock), time.monotonic()
            operator = LocalOperator(rig.daemon, clock)
            points, state = rig.bus.subscribe(topics.POINTS, latest()), rig.bus.subscribe(topics.EXPLORE, latest())
            async with rig.running():
                await clock.sleep(4.0)
                await operator.arm()
                await operator.call("explore", {**await operator.header(), "order": "start", "find": len(tags)})
                while clock.now() < limit * SECOND and not (state.latest.number and not state.latest.running):
                    await clock.sleep(5.0)
                newest, end = points.latest, state.latest
            judge(score, newest.points, tags, {tag.tag for tag in tags})
            collided = bool(rig.truth.array()[:, 5].any())
            return {
                **score.figures(),
                "outcome": end.outcome.value,
                "metres": end.travelled,
                "seconds": clock.now() / SECOND,
                "collided": collided,
                "real_seconds": time.monotonic() - begin,
            }

        return run_virtual(main, start=SECOND)


def main() -> None:
    """Run the selected parts."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--metres", type=float, default=40.0)
    parser.add_argument("--part", choices=("all", "light", "daemon"), default="all")
    parser.add_argument("--engines", default="plane,mujoco")
    given = parser.parse_args()
    figures: dict[str, Any] = {}
    scores = []
    if given.part != "daemon":
        for engine in given.engines.split(","):
            total = Score()
            try:
                for seed in range(1, given.seeds + 1):
                    for name in WORLDS:
                        one = light(name, engine, seed, given.metres)
                        print(f"{engine} {name} seed {seed}: {one.figures()}", flush=True)
                        total.add(one)
            except NotInstalledError as error:
                print(f"{engine}: left out: {error}")
                continue
            figures[engine] = total.figures()
            scores.append(figures[engine])
    if given.part != "light":
        figures["daemon"] = daemon(1)
        print(f"daemon: {figures['daemon']}", flush=True)
        scores.append(figures["daemon"])
    met = bool(scores) and all(
        one["recall"] >= GOALS["recall"]
        and one["false"] == 0
        and one["position_p95_mm"] is not None
        and one["position_p95_mm"] <= GOALS["position_p95_mm"]
        for one in scores
    )
    report = {"bench": "points", "figures": figures, "goals": GOALS, "met": met}
    OUTPUT.parent.mkdir(parents=True, exist_ok=True)
    OUTPUT.write_text(json.dumps(report, indent=1), encoding="utf-8")
    print(json.dumps(report))
    sys.exit(0 if met else 1)


if __name__ == "__main__":
    main()
