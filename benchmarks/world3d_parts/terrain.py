"""The whole daemon on uneven ground: level lidar, map and pose on hills; side slopes with the gate and without it."""

from collections.abc import Awaitable, Callable
from math import acos, ceil, degrees, hypot, pi, radians, tan
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import numpy as np
from scipy.ndimage import distance_transform_edt

from benchmarks import ROOT
from benchmarks.scoring import rms
from monstertruck_runtime.clock import SECOND, VirtualClock, run_virtual
from monstertruck_runtime.mailbox import latest
from monstertruck_runtime.map_files import OCCUPIED
from monstertruck_schemas import topics
from monstertruck_schemas.req import Order
from monstertruck_schemas.state import Grid
from monstertruck_sim.faults import FaultCatalog, FaultKind, apply
from monstertruck_sim.world.config import WorldConfig
from monstertruck_sim.world.world import World
from monstertruck_sim.world3d.ground import ground_heights
from monstertruck_sim.world3d.plant import RigidPlant
from monstertruckd.config.load import load_config
from monstertruckd.tools.drill.legs import default_jobs
from monstertruckd.tools.drill.random_drill import Drill
from monstertruckd.tools.drill.truck import DrillTruck
from monstertruckd.tools.simulation.config import DEADMAN_LINE, SimulatedTruckConfig, with_overlay

CONFIGS = ROOT / "configs"
ROUGH_DEG = 5.0
"""RMS of the ground's slope."""
WAVE = 1.5
GHOST = 0.15
"""An occupied cell of the map this far from every wall is none, m."""
OCCUPIED_FROM = 65
STANDS = 20.0
"""A truck that stands for this time does not drive on, s."""
SETTLED = 500
"""Samples, ten seconds from where the truck has begun to drive on a slope."""
FALLEN = radians(60.0)
TOP_HEAVY = {"friction": 1.5, "mass_height": 0.25}
"""A load on the roof, on ground that does not let it slide: computed, it falls at 29 to 33 degrees."""
RPM = 644 / (2 * pi * 0.075) * 60


class Driven(NamedTuple):
    """Result of one drive over ground; degrees and metres."""

    lidar: np.ndarray
    """Tilt of the scan plane at every 20 ms."""
    body: np.ndarray
    poses: np.ndarray
    """In the map, m and rad; shape (n, 3)."""
    true: np.ndarray
    """At the same instants."""
    way: np.ndarray
    """Metres driven so far at every sample."""
    walls: np.ndarray
    """Distance of every occupied cell from the nearest wall."""

    @property
    def errors(self) -> np.ndarray:
        """Return the errors of the pose, without alignment."""
        return np.hypot(*(self.poses - self.true)[:, :2].T)


def run(config: SimulatedTruckConfig, drive: Callable[[DrillTruck], Awaitable[Any]]) -> Any:
    """Return the result of ``drive`` on the virtual clock."""
    found: list[Any] = []

    async def main(clock: VirtualClock) -> None:
        async with DrillTruck.running(config, clock) as truck:
            found.append(await drive(truck))

    run_virtual(main, start=SECOND)
    return found[0]


def hills() -> list[dict[str, Any]]:
    """Return hills with the RMS slope over the demo's world, and a ramp."""
    feature = {"kind": "hills", "height": 0.05, "wavelength": WAVE, "seed": 5}
    config = WorldConfig.model_validate({"engine": "mujoco", "map": "loop", "ground": [feature]})
    heights = ground_heights(config, None, (-3.0, 3.0, -3.0, 3.0), [(9.0, 9.0, 0.0)])
    assert heights is not None
    rows, columns = np.gradient(heights.z, heights.resolution)
    slope = degrees(float(np.sqrt((np.arctan(np.hypot(rows, columns)) ** 2).mean())))
    ramp = {"kind": "slope", "x": -1.0, "y": 0.0, "angle_deg": 5.0, "length": 1.5}
    return [feature | {"height": 0.05 * tan(radians(ROUGH_DEG)) / tan(radians(slope))}, ramp]


def laps(metres: float, folder: Path) -> Path:
    """Write a path file of as many laps of the demo as have that length; return its path."""
    header, *points = (CONFIGS / "paths" / "loop.csv").read_text().splitlines()
    places = np.array([point.split(",")[:2] for point in points], dtype=float)
    lap = float(np.hypot(*np.diff(places, axis=0).T).sum())
    file = folder / "laps.csv"
    file.write_text("\n".join([header, *points[:-1] * ceil(metres / lap), points[-1]]) + "\n")
    return file


def over(ground: list[dict[str, Any]], metres: float, *, stabilised: bool) -> Driven:
    """Drive laps of the demo with a growing map; shorter if the truck stops."""
    with TemporaryDirectory() as folder:
        return _over(ground, metres, laps(metres, Path(folder)), stabilised=stabilised)


def _over(ground: list[dict[str, Any]], metres: float, path: Path, *, stabilised: bool) -> Driven:
    base = load_config(CONFIGS / "full3d.yaml", SimulatedTruckConfig)[0]
    overlay: dict[str, Any] = {
        "recorder": None,
        "map": None,
        "path": {"file": path, "closed": False},
        "slam": {"mode": "mapping"},
        "gate": {"tilt": {"slow": 0.3}},
        "sim": {"world": {"ground": ground}},
    }
    if not stabilised:
        overlay["devices"] = {"stabiliser": None}

    async def drive(truck: DrillTruck) -> Driven:
        pose, grids = truck.rig.bus.subscribe(topics.POSE, latest()), truck.rig.bus.subscribe(topics.MAP, latest())
        world, clock = truck.rig.world, truck.clock
        plant = world.plant
        assert isinstance(plant, RigidPlant)
        assert await truck.until(truck.drives, 30.0, Order.ARM)
        lidar, body, poses, true, ways, way, report = [], [], [], [], [], 0.0, 5.0
        then = world.truth(clock.now())
        moved = clock.now()
        while way < metres:
            await clock.sleep(0.02)
            now = world.truth(clock.now())
            if truck.drives():
                moved = clock.now()
            elif clock.now() - moved > STANDS * SECOND:
                why = "no state of the gate" if truck.gate is None else truck.gate.why
                print(f"the truck stands after {way:.1f} m: {why}", flush=True)
                break
            up = plant.data.body("lidar_head").xmat[8]
            lidar.append(degrees(acos(min(1.0, float(up)))))
            body.append(degrees(hypot(now.pitch, now.roll)))
            way += hypot(now.x - then.x, now.y - then.y)
            then = now
            if (heard := pose.latest) is not None:
                poses.append((heard.pose.x, heard.pose.y, heard.pose.yaw))
                true.append((now.x, now.y, now.yaw))
                ways.append(way)
            if way > report:
                report += 5.0
                tilt = f"lidar {rms(np.array(lidar)):.2f} degrees RMS, {max(lidar):.2f} at most"
                error = np.hypot(*(np.array(poses) - np.array(true))[:, :2].T)
                print(f"{way:.0f} m: {tilt}; pose {rms(error) * 100:.2f} cm", flush=True)
        await clock.sleep(2.0)
        grid = grids.latest
        walls = np.zeros(0) if grid is None else to_walls(grid, world)
        return Driven(np.array(lidar), np.array(body), np.array(poses), np.array(true), np.array(ways), walls)

    return run(with_overlay(base, overlay), drive)


def aligned_ate(poses: np.ndarray, true: np.ndarray) -> float:
    """Return the RMS distance after the least-squares alignment to the true path (Umeyama 1991); m."""
    a, b = poses[:, :2] - poses[:, :2].mean(0), true[:, :2] - true[:, :2].mean(0)
    turn = np.arctan2((a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum(), (a * b).sum())
    c, s = np.cos(turn), np.sin(turn)
    return rms(np.hypot(*(a @ np.array([[c, s], [-s, c]]) - b).T))


def to_walls(grid: Grid, world: World) -> np.ndarray:
    """Return the distance of every occupied cell of a map from the nearest solid cell of the world, m."""
    base = world.map
    far = distance_transform_edt(base.cells != OCCUPIED) * base.resolution
    cells = np.asarray(grid.cells).reshape(grid.height, grid.width)
    rows, columns = np.nonzero(cells >= OCCUPIED_FROM)
    x = grid.origin.x + (columns + 0.5) * grid.resolution - base.origin[0]
    y = grid.origin.y + (rows + 0.5) * grid.resolution - base.origin[1]
    row = np.clip((y / base.resolution).astype(int), 0, base.cells.shape[0] - 1)
    column = np.clip((x / base.resolution).astype(int), 0, base.cells.shape[1] - 1)
    return np.asarray(far[row, column])


def kept(keep: Path | None, name: str, metres: float, drive: Callable[[], Driven]) -> Driven:
    """Return a drive, or its finished result in the folder."""
    file = None if keep is None else keep / f"{name}-{metres:g}.npz"
    if file is None:
        return drive()
    if not file.exists():
        file.parent.mkdir(parents=True, exist_ok=True)
        np.savez(file, **drive()._asdict())
    with np.load(file) as saved:
        return Driven(**{field: saved[field] for field in Driven._fields})


def rough(metres: float, keep: Path | None = None) -> dict[str, float]:
    """Measure lidar, map and pose on hills; on the flat for comparison, and without stabiliser.

    With a folder ``keep``, finished drives are not repeated.
    """
    figures: dict[str, float] = {}
    grounds = {"flat": ([], True), "rough": (hills(), True), "unstabilised": (hills(), False)}
    for name, (ground, stabilised) in grounds.items():
        it = kept(
            keep, name, metres, lambda ground=ground, with_it=stabilised: over(ground, metres, stabilised=with_it)
        )
        settled = it.lidar[min(SETTLED, len(it.lidar) - 1) :]
        figures |= {
            f"{name}_way": float(it.way[-1]) if len(it.way) else 0.0,
            f"{name}_way_share": float(it.way[-1]) / metres if len(it.way) else 0.0,
            f"{name}_body_deg_rms": rms(it.body),
            f"{name}_lidar_deg_rms": rms(it.lidar),
            f"{name}_lidar_deg_max": float(it.lidar.max()),
            f"{name}_lidar_settled_deg_rms": rms(settled),
            f"{name}_lidar_settled_deg_max": float(settled.max()),
            f"{name}_ate_cm": rms(it.errors) * 100 if len(it.errors) else float("inf"),
            f"{name}_ate_aligned_cm": aligned_ate(it.poses, it.true) * 100 if len(it.poses) else float("inf"),
        }
        if len(it.walls):
            real = it.walls[it.walls < GHOST]
            figures[f"{name}_wall_error_cm"] = rms(real) * 100
            figures[f"{name}_ghost_share"] = float((it.walls >= GHOST).mean())
    if "rough_wall_error_cm" in figures:
        figures["rough_over_flat_walls"] = figures["rough_wall_error_cm"] / figures["flat_wall_error_cm"]
    return figures


def hillside(seed: int) -> dict[str, Any]:
    """Return the hall with a hillside that the truck climbs at an angle; angles by the seed."""
    rng = np.random.default_rng(seed)
    angle, aslant = float(rng.uniform(37.0, 40.0)), float(rng.uniform(0.3, 0.5))
    side = float(rng.choice([-1.0, 1.0]))
    slope = {
        "kind": "slope",
        "x": 1.5,
        "y": 0.0,
        "direction": side * (pi / 2 - aslant),
        "angle_deg": angle,
        "length": 2.5,
    }
    start = {"x": 0.0, "y": 0.0, "yaw": 0.0}
    return {"engine": "mujoco", "map": "hall", "start": start, "ground": [slope], "mechanics": TOP_HEAVY}


def slopes(seeds: int) -> dict[str, float]:
    """Return how many trucks that drive onto a hillside fall over, with the daemon and without one."""
    fallen, bare, steepest = 0, 0, 0.0
    base = load_config(CONFIGS / "world3d" / "side_slope.yaml", SimulatedTruckConfig)[0]
    for seed in range(1, seeds + 1):
        world = hillside(seed)
        tilt = run(with_overlay(base, {"recorder": None, "sim": {"seed": seed, "world": world}}), _onto)
        fallen, steepest = fallen + (tilt > FALLEN), max(steepest, tilt)
        alone = World(WorldConfig.model_validate(world), seed)
        alone.truth(0)
        alone.motors[0].command(0, -0.2 * RPM, 20_000.0)
        tilt = max(_tilted(alone, step * SECOND // 20) for step in range(1, 500))
        bare += tilt > FALLEN
        print(f"seed {seed}: {fallen} overturned with the gate, {bare} without", flush=True)
    return {
        "slope_seeds": seeds,
        "slope_overturned": fallen,
        "slope_greatest_tilt_deg": degrees(steepest),
        "slope_overturned_without": bare,
    }


def drilled(count: int, keep: Path | None = None) -> dict[str, float]:
    """Cause seeded faults on the whole truck; return metres without computer, with and without the deadman line.

    With a folder ``keep``, a second run continues after the finished legs of the first.
    """
    truck = load_config(CONFIGS / "full3d.yaml", SimulatedTruckConfig)[0]
    report = Drill(1, count, truck).run(jobs=default_jobs(), resume=None if keep is None else keep / "drill.jsonl")
    figures = {f"drill_{k}": float(value) for k, value in report.figures().items() if isinstance(value, int | float)}
    figures["drill_computer_power_faults"] = sum(o.kind is FaultKind.COMPUTER_POWER for o in report.outcomes)
    for name, overlay in (("with", DEADMAN_LINE), ("without", {})):
        config = with_overlay(truck, {"recorder": None, "map": None, **overlay})
        figures[f"drill_metres_without_computer_{name}_line"] = run(config, _unpowered)
    return figures


async def _unpowered(truck: DrillTruck) -> float:
    """Return the distance (m) driven in ten seconds after its computer's supply (M4-ATX) fails."""
    assert await truck.until(truck.drives, 15.0, Order.ARM)
    rig, clock = truck.rig, truck.clock
    await clock.sleep(2.0)
    catalog = FaultCatalog(rig.config.devices, (), records=False, restarts=True, workers=())
    lost = catalog.draw(
        np.random.default_rng(1), without=frozenset(kind for kind in FaultKind if kind is not FaultKind.COMPUTER_POWER)
    )
    await apply(lost.start, rig.context)
    then, way = rig.world.truth(clock.now()), 0.0
    for _ in range(200):
        await clock.sleep(0.05)
        now = rig.world.truth(clock.now())
        way, then = way + hypot(now.x - then.x, now.y - then.y), now
    return way


async def _onto(truck: DrillTruck) -> float:
    assert await truck.until(truck.drives, 15.0, Order.ARM)
    world, clock = truck.rig.world, truck.clock
    greatest = 0.0
    for _ in range(500):
        await clock.sleep(0.05)
        greatest = max(greatest, _tilted(world, clock.now()))
    return greatest


def _tilted(world: World, time_ns: int) -> float:
    truth = world.truth(time_ns)
    return hypot(truth.pitch, truth.roll)
