"""The world in three dimensions: against closed forms, against the plane, and how fast it is.

    python benchmarks/world3d.py
        [--parts scans mechanics turning step speed lap slopes rough patch drill fleet robots webcam]
        [--seeds 20] [--metres 60] [--count 200] [--keep FOLDER]

``scans``: standing scans without noise from free poses against the plane's. ``mechanics``: sag under a load, overturn
angle, pull of the clutch, a lifted wheel. ``turning``: radius in every steering mode against ``common_motion`` (least
squares of the wheels' side slips) and against the least sum of slips, which is what dry friction makes. ``step``: how
far half the step moves the end of a drive. ``speed``: one step, one swept scan, one picture. ``lap``: the demo's lap by
the whole daemon, its error, its speed, twice the same. ``slopes``: trucks that drive onto a hillside, by the daemon and
without one. ``rough``: lidar, map and pose on hills of 5 degrees RMS. ``patch``: whether
rough ground is found, and routes go round it. ``drill``: seeded faults, with a deadman line and without. ``fleet``: two
robots and people, a daemon for each robot. ``robots``: every body drives a bend, one follows a wall by sonars.
``webcam``: the whole daemon with its rendered camera. The last line is JSON.
"""

import argparse
import json
import tempfile
import time
from collections.abc import Callable
from math import cos, degrees, hypot, pi, sin
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

import monstertruck_sim.world3d.model as rigid_model
import monstertruck_sim.world3d.plant as rigid_plant
from benchmarks import ROOT
from benchmarks.world3d_parts.fleet import fleet
from benchmarks.world3d_parts.patch import patch
from benchmarks.world3d_parts.robots import robots
from benchmarks.world3d_parts.terrain import drilled, rough, slopes
from benchmarks.world3d_parts.webcam import webcam
from monstertruck_kinematics.description import Mechanics
from monstertruck_kinematics.linkage import common_motion
from monstertruck_kinematics.polynomials import SteeringPolynomials
from monstertruck_kinematics.truck import FourWheelSteering
from monstertruck_runtime.errors import InputError, NotInstalledError
from monstertruck_schemas.base import Pose2D
from monstertruck_sim.world.config import MechanicsConfig, ServoModelConfig, SimTruckConfig, WorldConfig
from monstertruck_sim.world.world import World
from monstertruck_sim.world3d.picture import WorldRenderer, looking_at
from monstertruck_sim.world3d.plant import RigidPlant
from monstertruckd.tools.demo.runs import run_fast_demo

SECOND = 1_000_000_000
RPM = 644 / (2 * pi * 0.075) * 60
"""Speed of the motor (rpm) at one metre per second."""
GRAVITY = 9.81
GOALS: dict[str, tuple[str, float]] = {
    "scan_share_within_1mm": (">=", 0.999),
    "sag_error": ("<=", 0.02),
    "overturn_error_deg": ("<=", 1.0),
    "clutch_error": ("<=", 0.05),
    "lifted_wheel_share": (">=", 0.95),
    "half_step_moves_end": ("<=", 0.01),
    "turning_error_common_motion": ("<=", 0.05),
    "step_us": ("<=", 60.0),
    "scan_ms": ("<=", 1.5),
    "picture_ms": ("<=", 66.0),
    "lap_cross_track_cm": ("<=", 1.5),
    "lap_speed": (">=", 6.0),
    "same_log": (">=", 1.0),
    "slope_overturned": ("<=", 0.0),
    "slope_overturned_without": (">=", 1.0),
    "flat_way_share": (">=", 1.0),
    "rough_way_share": (">=", 1.0),
    "rough_lidar_deg_rms": ("<=", 1.0),
    "rough_lidar_deg_max": ("<=", 3.0),
    "rough_over_flat_walls": ("<=", 1.5),
    "rough_ghost_share": ("<=", 0.01),
    "rough_ate_aligned_cm": ("<=", 5.0),
    "patch_narrow_reached": (">=", 1.0),
    "patch_narrow_last_m_on_stones": ("<=", 0.0),
    "patch_narrow_detour": ("<=", 1.5),
    "patch_spanning_reached": (">=", 1.0),
    "drill_unsafe": ("<=", 0.0),
    "fleet_followed": (">=", 1.0),
    "fleet_contacts_by_robots": ("<=", 0.0),
    "fleet_same": (">=", 1.0),
    "robots_reached": (">=", 1.0),
    "robots_cross_track_cm": ("<=", 3.0),
    "robots_wall_followed": (">=", 1.0),
    "robots_wall_error_cm": ("<=", 3.0),
    "webcam_speed": (">=", 1.0),
    "webcam_pictures_per_s": (">=", 14.5),
}


class Hands:
    """Control of motor and servos of a world whose time is ``now``."""

    def __init__(self, world: World) -> None:
        self.world, self.now = world, 0
        plant = world.plant
        assert isinstance(plant, RigidPlant)
        self.plant = plant
        self.pulses: dict[int, float | None] = {0: None, 1: None}
        world.servos.attach(self)
        world.truth(0)

    def pulse_us(self, channel: int, time_ns: int) -> float | None:
        """Pulse of a servo, us."""
        return self.pulses[channel]

    def steer(self, front: float, rear: float) -> None:
        """Set both axles, rad."""
        for channel, angle in zip((1, 0), SteeringPolynomials().servo_from_axles(front, rear), strict=True):
            servo = ServoModelConfig(channel=channel)
            self.pulses[channel] = servo.centre_us + servo.us_per_degree * degrees(angle)

    def drive(self, speed: float) -> None:
        """Set the wheel speed, m/s."""
        self.world.motors[0].command(self.now, -speed * RPM, 20_000.0)

    def wait(self, seconds: float) -> Any:
        """Let the time pass; return the truth afterwards."""
        self.now += round(seconds * SECOND)
        return self.world.truth(self.now)


def hands(**config: Any) -> Hands:
    """Return the control of a truck without noise in the middle of an open yard."""
    start = Pose2D(x=0.0, y=0.0, yaw=0.0)
    return Hands(World(WorldConfig(engine="mujoco", map="yard", noise=False, start=start, **config), 1))


def scans() -> dict[str, float]:
    """Return the share of beams that differ by at most 1 mm from the plane's."""
    equal = beams = 0
    rng = np.random.default_rng(1)
    for name, count in (("loop", 10), ("rooms", 20), ("corridor_maze", 10), ("hall", 10)):
        found = 0
        while found < count:
            base = World(WorldConfig(map=name), 1).map
            rows, columns = base.cells.shape
            x = base.origin[0] + float(rng.uniform(0, columns)) * base.resolution
            y = base.origin[1] + float(rng.uniform(0, rows)) * base.resolution
            start = Pose2D(x=x, y=y, yaw=float(rng.uniform(-3.1, 3.1)))
            try:
                pair = [
                    World(WorldConfig(engine=engine, map=name, noise=False, start=start), 1).lidar.scan(0)
                    for engine in ("mujoco", "plane")
                ]
            except InputError:
                continue
            found += 1
            equal += int((abs(pair[0] - pair[1]) <= 1).sum())
            beams += len(pair[0])
    return {"scan_beams": beams, "scan_share_within_1mm": equal / beams}


def overturn(parts: Mechanics, track: float, radius: float) -> float:
    """Return the side slope at which the outer wheels carry everything, rad, of a body that leans on its springs."""
    arm, height = track / 2, parts.mass_height - radius  # a round tread carries in its middle
    roll_spring = 2 * parts.axle_spring * (track / 3) ** 2
    sprung, unsprung = parts.sprung, parts.mass - parts.sprung

    def holds(slope: float) -> bool:
        lean = 0.0
        for _ in range(200):
            lean = min(sprung * GRAVITY * height * sin(slope + lean) / roll_spring, parts.axle_roll)
        moment = sprung * ((arm - height * sin(lean)) * cos(slope) - (radius + height * cos(lean)) * sin(slope))
        return moment + unsprung * (arm * cos(slope) - radius * sin(slope)) > 0

    low, high = 0.0, 1.5
    for _ in range(50):
        middle = (low + high) / 2
        low, high = (middle, high) if holds(middle) else (low, middle)
    return low


def mechanics() -> dict[str, float]:
    """Compare with closed forms."""
    parts = Mechanics()
    it = hands()
    base = it.plant.model.body("base").id
    it.wait(2.0)
    before = float(it.plant.data.qpos[2])
    it.plant.data.xfrc_applied[base, 2] = -20.0
    it.wait(3.0)
    springs = float(np.mean([it.plant.data.joint(f"{axle}_suspension").qpos[0] for axle in ("front", "rear")]))
    sag = 20.0 / (2 * parts.axle_spring)
    figures = {"sag_mm": springs * 1e3, "sag_error": abs(springs / sag - 1.0)}
    figures["sag_with_tyres_mm"] = (before - float(it.plant.data.qpos[2])) * 1e3

    it = hands(mechanics=MechanicsConfig(friction=3.0))
    slope, at = 0.5, None
    while at is None and slope < 1.3:
        slope += 0.002
        it.plant.model.opt.gravity[:] = 0.0, -GRAVITY * sin(slope), -GRAVITY * cos(slope)
        if abs(it.wait(0.1).roll) > 0.35:
            at = slope
    expected = overturn(Mechanics(friction=3.0), 0.26, 0.075)
    figures |= {
        "overturn_deg": degrees(at or 0.0),
        "overturn_expected_deg": degrees(expected),
        "overturn_error_deg": abs(degrees((at or 0.0) - expected)),
    }

    low, high = 15.0, 30.0
    for _ in range(9):  # against a steady pull backwards the truck drives on, or stands and its clutch slips
        it, middle = hands(), (low + high) / 2
        it.drive(0.2)
        it.wait(2.0)
        it.plant.data.xfrc_applied[base, 0] = -middle
        low, high = (middle, high) if it.wait(8.0).v > 0.1 else (low, middle)
    pull = low + SimTruckConfig().rolling_resistance * 7.25 * GRAVITY
    figures |= {"clutch_n": pull, "clutch_error": abs(pull / 25.0 - 1.0)}

    it = hands()
    knuckle = it.plant.model.body("front_left_wheel").id
    it.plant.data.xfrc_applied[knuckle, 2] = 25.0  # more than the wheel carries
    it.plant.data.xfrc_applied[base, 0] = -30.0  # and the truck is held
    it.drive(0.1)
    it.wait(4.0)
    spins = {name: float(it.plant.data.joint(f"front_{name}_spin").qvel[0]) for name in ("left", "right")}
    wanted = 0.1 / 0.075
    figures |= {"lifted_wheel_rad_s": spins["left"], "lifted_wheel_share": spins["left"] / (2 * wanted)}
    return figures


def least_sum(geometry: FourWheelSteering, angles: tuple[float, ...]) -> float:
    """Return the curvature with the least sum of the wheels' side slips, 1/m: a vertex, where two wheels roll."""
    places = geometry.wheel_positions
    best = (np.inf, 0.0)
    for i in range(4):
        for j in range(i + 1, 4):
            rows = [(cos(a), cos(a) * x + sin(a) * y, sin(a)) for a, (x, y) in zip(angles, places, strict=True)]
            system = np.array([rows[i][:2], rows[j][:2]])
            if abs(np.linalg.det(system)) < 1e-9:
                continue
            slide, turn = np.linalg.solve(system, [rows[i][2], rows[j][2]])
            slips = sum(abs(a * slide + b * turn - c) for a, b, c in rows)
            if slips < best[0] - 1e-9:
                best = slips, turn / hypot(1.0, slide)
    return best[1]


def turning() -> dict[str, float]:
    """Return the curvature in every steering mode relative to least squares, and to the least sum of slips."""
    linkage = SimTruckConfig().chassis().linkage
    geometry = FourWheelSteering()
    figures: dict[str, float] = {}
    worst = worst_dry = 0.0
    print("turning       rigid   least squares   least sum, 1/m")
    for mode, front, rear in (
        ("front", 0.35, 0.0),
        ("rear", 0.0, 0.35),
        ("counter", 0.35, -0.35),
        ("gentle", 0.1, -0.1),
    ):
        it = hands()
        it.steer(front, rear)
        it.drive(0.2)
        it.wait(2.0)
        begin = it.wait(0.1)
        end = it.wait(4.0)
        rigid = (end.yaw - begin.yaw) / 4.0
        rigid = ((rigid * 4.0 + pi) % (2 * pi) - pi) / 4.0 / end.v
        angles = linkage.wheel_angles(*SteeringPolynomials().servo_from_axles(front, rear))  # type: ignore[union-attr]
        slide, turn, _ = common_motion(geometry, angles)
        squares, dry = turn / hypot(1.0, slide), least_sum(geometry, angles)
        print(f"{mode:10} {rigid:8.3f} {squares:12.3f} {dry:12.3f}")
        figures |= {f"turning_{mode}_over_squares": rigid / squares, f"turning_{mode}_over_sum": rigid / dry}
        worst, worst_dry = max(worst, abs(rigid / squares - 1)), max(worst_dry, abs(rigid / dry - 1))
    return figures | {"turning_error_common_motion": worst, "turning_error_least_sum": worst_dry}


def step() -> dict[str, float]:
    """Return how far half the step moves the end of a drive of 60 s with bends to both sides."""
    ends = []
    for share in (1, 2):
        seconds = 0.002 / share
        rigid_model.TIMESTEP = rigid_plant.TIMESTEP = seconds  # type: ignore[attr-defined, misc]
        RigidPlant.STEP_NS = round(seconds * 1e9)
        it = hands()
        it.drive(0.2)
        for front, rear in ((0.0, 0.0), (0.3, -0.3), (-0.3, 0.3), (0.25, 0.0), (0.0, 0.3), (0.2, 0.2)):
            it.steer(front, rear)
            truth = it.wait(10.0)
        ends.append((truth.x, truth.y))
    rigid_model.TIMESTEP = rigid_plant.TIMESTEP = 0.002  # type: ignore[attr-defined, misc]
    RigidPlant.STEP_NS = 2_000_000
    return {"half_step_moves_end": hypot(ends[0][0] - ends[1][0], ends[0][1] - ends[1][1])}


def best(run: Callable[[], object], count: int, rounds: int = 7) -> float:
    """Return the processor time of a call (s), the best of some rounds, because other programs share the computer."""
    found = []
    for _ in range(rounds):
        begin = time.thread_time()
        for _ in range(count):
            run()
        found.append((time.thread_time() - begin) / count)
    return min(found)


def speed() -> dict[str, float]:
    """Return the cost of one step of MuJoCo and of the plant, of one swept scan, of one image."""
    figures: dict[str, float] = {}
    for name in ("level", "hills"):
        features = [] if name == "level" else [{"kind": "hills", "height": 0.03}]
        config = {"engine": "mujoco", "map": "loop", "ground": features}
        it = Hands(World(WorldConfig.model_validate(config), 1))
        it.drive(0.2)
        it.wait(1.0)
        model, data = it.plant.model, it.plant.data
        figures[f"mujoco_step_{name}_us"] = best(lambda m=model, d=data: mujoco.mj_step(m, d), 500) * 1e6
        figures[f"plant_step_{name}_us"] = best(lambda i=it: i.wait(0.002), 300) * 1e6
        figures[f"scan_{name}_ms"] = best(lambda i=it: i.world.lidar.scan(i.now), 30) * 1e3
    figures["step_us"] = figures["mujoco_step_hills_us"]
    figures["scan_ms"] = figures["scan_hills_ms"]
    try:
        renderer = WorldRenderer(model, 640, 480)
    except NotInstalledError as error:
        print(f"no pictures: {error}")
        return figures
    eye = looking_at((-1.5, -2.4, 1.0), (0.0, -1.7, 0.1))
    renderer.draw(data, eye)
    waits = []
    for _ in range(9):  # by the clock, for the software that draws has threads of its own
        begin = time.perf_counter()
        renderer.draw(data, eye)
        waits.append(time.perf_counter() - begin)
    figures["picture_ms"] = min(waits) * 1e3
    renderer.close()
    return figures


def lap(keep: Path | None) -> dict[str, float]:
    """Drive the lap of the whole daemon twice."""
    digests, speeds, errors = [], [], []
    with tempfile.TemporaryDirectory() as folder:
        for i in range(2):
            summary = run_fast_demo(ROOT / "configs" / "full3d.yaml", (keep or Path(folder)) / f"lap{i}", None)
            digests.append(summary.digest)
            speeds.append(summary.speedup)
            errors.append(summary.lap.cross_track_rms * 100)
    return {"lap_cross_track_cm": max(errors), "lap_speed": max(speeds), "same_log": float(len(set(digests)) == 1)}


PARTS: dict[str, Callable[[], dict[str, float]]] = {
    "scans": scans,
    "mechanics": mechanics,
    "turning": turning,
    "step": step,
    "speed": speed,
}


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    names = [*PARTS, "lap", "slopes", "rough", "patch", "drill", "fleet", "robots", "webcam"]
    parser.add_argument("--parts", nargs="+", default=names, choices=names)
    parser.add_argument("--seeds", type=int, default=20, help="of the slopes")
    parser.add_argument("--metres", type=float, default=60.0, help="on rough ground")
    parser.add_argument("--count", type=int, default=200, help="of faults")
    parser.add_argument(
        "--keep", type=Path, help="folder for the laps' logs, and for finished drives and legs of the drill"
    )
    arguments = parser.parse_args()
    if arguments.keep is not None:
        arguments.keep.mkdir(parents=True, exist_ok=True)
    figures: dict[str, float] = {}
    calls = PARTS | {
        "lap": lambda: lap(arguments.keep),
        "slopes": lambda: slopes(arguments.seeds),
        "rough": lambda: rough(arguments.metres, arguments.keep),
        "patch": patch,
        "fleet": fleet,
        "robots": robots,
        "webcam": webcam,
        "drill": lambda: drilled(arguments.count, arguments.keep),
    }
    for part in arguments.parts:
        figures |= calls[part]()
    for name, value in figures.items():
        print(f"{name:32} {value:12.5g}")
    goals = {name: f"{sign} {value:g}" for name, (sign, value) in GOALS.items() if name in figures}
    met = all(
        figures[name] >= value if sign == ">=" else figures[name] <= value
        for name, (sign, value) in GOALS.items()
        if name in figures
    )
    print(json.dumps({"bench": "world3d", "parts": arguments.parts, "figures": figures, "goals": goals, "met": met}))


if __name__ == "__main__":
    main()
