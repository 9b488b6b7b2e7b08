"""5.2 Mapping: map and pose of a lap of the built-in loop against the world, whole daemon on the virtual clock.

Compares the pose by scan matching and loop closures with dead reckoning alone, over the same lap. The author's mappers
(CRSM, gmapping) are not part of this repository.
"""

from typing import Any

import numpy as np

from benchmarks import scoring
from benchmarks.exploration_parts.arena import Arena
from benchmarks.navigation_parts import Options, Part
from benchmarks.navigation_parts.daemon import CONFIGS
from monstertruck_runtime.clock import SECOND, VirtualClock, run_virtual
from monstertruck_schemas import topics
from monstertruckd.config.load import load_config
from monstertruckd.tools.figures import new_figure, write_figure
from monstertruckd.tools.simulation.config import SimulatedTruckConfig, with_overlay
from monstertruckd.tools.simulation.operator import LocalOperator
from monstertruckd.tools.simulation.virtual_rig import VirtualRig

SECONDS, QUICK_SECONDS = 75.0, 5.0
WALLS = 0.05
"""Metres by which walls are widened before maps are laid upon one another."""


def run(options: Options) -> Part:
    part = Part()
    found = lap(QUICK_SECONDS if options.quick else SECONDS)
    arena, grid = Arena.load("loop", CONFIGS / "worlds" / "loop.yaml"), found["grid"]
    for name in ("slam", "reckoning"):
        goal = 0.05 if name == "slam" else None
        score = scoring.trajectory(found[name][:, 1:], found[f"true_{name}"])
        part.add(f"{name}.ate_m", score["ate_m"], goal)
        part.add(f"{name}.max_m", score["max_m"])
        part.add(
            f"{name}.rpe_1s_m", scoring.relative(found[name][:, 0], found[name][:, 1:], found[f"true_{name}"], 1.0)
        )
        part.add(f"{name}.end_m", score["end_m"])
        part.add(f"{name}.driven_m", score["driven_m"])
    cells = grid.cells.reshape(grid.height, grid.width)
    where = (grid.origin.x, grid.origin.y), grid.resolution, arena.truth
    for key, value in scoring.map_error(cells, *where).items():
        part.add(f"map.{key}", value, 0.05 if key == "wall_mean_m" else None)
    part.add("map.wall_iou", scoring.wall_iou(cells, *where, WALLS))
    draw(options, found, cells, arena)
    return part


def lap(seconds: float) -> dict[str, Any]:
    """Return poses (n, 4; s first), the true ones of the same instants, and the last map."""
    config = load_config(CONFIGS / "slam.yaml", SimulatedTruckConfig)[0]
    config = with_overlay(
        config, {"recorder": None, "blackbox": None, "map": None, "stand": "simulator", "slam": {"map_period": 1.0}}
    )
    poses: dict[str, list[tuple[float, ...]]] = {"slam": [], "reckoning": []}
    names = {topics.POSE.name: "slam", topics.ODOMETRY.name: "reckoning"}

    def heard(topic: Any, message: Any, data: Any, at: Any) -> None:
        pose = message.pose
        poses[names[topic.name]].append((message.stamp / SECOND, pose.x, pose.y, pose.yaw))

    async def main(clock: VirtualClock) -> tuple[np.ndarray, Any]:
        rig = VirtualRig(config, clock)
        rig.bus.tap(heard, [topics.POSE, topics.ODOMETRY])
        async with rig.running():
            await clock.sleep(2.0)
            await LocalOperator(rig.daemon, clock).arm()
            await clock.sleep(seconds)
            return rig.truth.array()[:, :4], rig.bus.newest(topics.MAP)

    true, grid = run_virtual(main)
    result: dict[str, Any] = {"grid": grid}
    for name, said in poses.items():
        rows = np.array(said)
        rows = rows[(rows[:, 0] >= true[0, 0]) & (rows[:, 0] <= true[-1, 0])]
        result |= {name: rows, f"true_{name}": scoring.at(true[:, 0], true[:, 1:], rows[:, 0])}
    return result


def draw(options: Options, found: dict[str, Any], cells: np.ndarray, arena: Arena) -> None:
    grid = found["grid"]
    figure = new_figure(8, 7)
    axes = figure.subplots()
    x, y, step = grid.origin.x, grid.origin.y, grid.resolution
    box = (x, x + grid.width * step, y, y + grid.height * step)
    axes.imshow(np.where(cells < 0, 50, cells), origin="lower", extent=box, cmap="Greys", alpha=0.7)
    rows, columns = arena.blocked.shape
    (x, y), step = arena.origin, arena.resolution
    walls = (x, x + columns * step, y, y + rows * step)
    axes.contour(arena.blocked, [0.5], extent=walls, colors="tab:blue", linewidths=0.8)
    axes.plot([], [], color="tab:blue", lw=0.8, label="true walls")
    axes.set(xlim=box[:2], ylim=box[2:], aspect="equal", xlabel="x, m", ylabel="y, m")
    axes.plot(*found["true_slam"][:, :2].T, color="0.5", lw=3, label="truth")
    for name, colour in (("reckoning", "tab:orange"), ("slam", "tab:red")):
        axes.plot(*found[name][:, 1:3].T, color=colour, lw=1, label=name)
    axes.legend(loc="center")
    write_figure(figure, options.out / "slam.png")
