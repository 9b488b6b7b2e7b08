"""``monstertruckd plan``: a route over a map, without a robot."""

import math
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from monstertruckd.tools.cli.options import ViaOption, complete_planner, parse_pose
from monstertruckd.tools.cli.output import JsonOption, finish, print_json, remark

if TYPE_CHECKING:
    from monstertruck_planners.route.api import RouteMap, RoutePlanner, RouteResult, Vehicle
    from monstertruck_runtime.map_files import WorldMap


class SteeringChoice(StrEnum):
    """Modes of steering."""

    FRONT = "2ws"
    COUNTER = "counter"
    BOTH = "4ws"


class UnknownChoice(StrEnum):
    """Treatments of unknown cells."""

    BLOCKED = "blocked"
    DEAR = "dear"
    FREE = "free"


PoseArgument = Annotated[
    str, typer.Argument(metavar="X,Y,YAW", show_default=False, help="Pose of the base, m, m, degrees (or 1.57rad).")
]


def plan(
    map_file: Annotated[
        Path, typer.Argument(metavar="MAP", help="Folder of a saved map, or a map_server YAML.", show_default=False)
    ],
    start: PoseArgument,
    goal: PoseArgument,
    planner: Annotated[
        str, typer.Option("--planner", "-p", help="Kind of route planner.", autocompletion=complete_planner)
    ] = "hybrid",
    steering: Annotated[
        SteeringChoice, typer.Option(help="Use the front axle only, both axles opposite, or both in all modes.")
    ] = SteeringChoice.BOTH,
    via: ViaOption = None,
    unknown: Annotated[UnknownChoice, typer.Option(help="How to treat unknown cells.")] = UnknownChoice.BLOCKED,
    budget: Annotated[
        float, typer.Option(min=0.01, help="Processor time for search and improvement of the route, s.")
    ] = 1.0,
    reproducible: Annotated[
        bool, typer.Option("--reproducible", help="Limit the work instead of the time: equal inputs give equal routes.")
    ] = False,
    picture: Annotated[Path | None, typer.Option("--png", help="Draw map and route to this file.")] = None,
    json_output: JsonOption = False,
) -> None:
    """Plan a route over a map and print or draw it.

    The truck is the Monstertruck; poses are poses of its base. Without a route, the exit code is the reason.
    """
    from monstertruck_planners.route.api import RouteMap, Vehicle, make_planner, warm_up
    from monstertruck_planners.route.catalog import ROUTE_PLANNERS
    from monstertruck_runtime.clock import processor_time
    from monstertruck_runtime.map_files import load_map

    world = load_map(map_file)
    for text in world.remarks:
        remark(text)
    route_map = RouteMap.from_cells(world.cells, world.resolution, (*world.origin, 0.0), unknown.value)
    vehicle = Vehicle.truck(steering.value)
    settings: Any = ROUTE_PLANNERS.find(planner).settings_class()
    planning = make_planner(vehicle, settings(kind=planner, budget=budget, unknown=unknown.value))
    if not reproducible:
        warm_up(planning)
    now = None if reproducible else processor_time
    result = _route(planning, route_map, vehicle, (parse_pose(start), parse_pose(goal)), via or [], now)
    if picture is not None:
        _draw(picture, world, vehicle, result, map_file.stem)
    if json_output:
        print_json(_report(result, vehicle))
    elif result.ok:
        _print_summary(result)
    finish(result.reason, f"{result.reason.text}: {result.text}")


def _route(
    planner: "RoutePlanner", route_map: "RouteMap", vehicle: "Vehicle",
    ends: tuple[tuple[float, ...], tuple[float, ...]],
    via: list[str], now: Any,
) -> "RouteResult":  # fmt: skip
    from monstertruck_planners.route.replan import ViaPoint, plan_through

    start, goal = (vehicle.reference_pose(pose) for pose in ends)
    if not via:
        return planner.plan(route_map, start, goal, now)
    poses = [parse_pose(text, yaw_needed=False) for text in via]
    places = [ViaPoint(*(pose if len(pose) == 2 else vehicle.reference_pose(pose).tolist())) for pose in poses]
    return plan_through(planner, route_map, start, [*places, ViaPoint(*goal.tolist())], now)


def _report(result: "RouteResult", vehicle: "Vehicle") -> dict[str, Any]:
    from monstertruck_planners.route.motion import moved

    report: dict[str, Any] = {"reason": result.reason, "text": result.text, "statistics": result.statistics}
    if result.path is not None:
        path = result.path
        report |= {
            "length": path.length,
            "backward": path.backward,
            "cusps": path.cusps,
            "cost": result.cost,
            "least_radius": 1 / path.greatest_curvature if path.greatest_curvature else None,
            "reference": path.reference,
            "segments": [
                {
                    "kind": "arc" if curvature else "crab" if sideslip else "line",
                    "length": abs(length),
                    "direction": 1 if length > 0 else -1,
                    "curvature": curvature,
                    "sideslip": sideslip,
                    "steering": steering,
                }
                for (length, curvature, sideslip), steering in zip(path.segments.tolist(), path.steering, strict=True)
            ],
            "poses": path.base_poses(0.05).tolist(),
        }
    elif result.poses is not None:
        report |= {"cost": result.cost, "poses": moved(result.poses, -vehicle.reference).tolist()}
    return report


def _print_summary(result: "RouteResult") -> None:
    statistics = result.statistics
    first = f", first route after {statistics['first_s'] * 1e3:.1f} ms" if statistics.get("elapsed_s") else ""
    if result.path is None:
        print(f"grid path of cost {result.cost:.2f} m, no drivable motion{first}")
        return
    path = result.path
    tightest = f", minimum radius {1 / path.greatest_curvature:.3f} m" if path.greatest_curvature else ""
    driven = f"{path.length:.2f} m ({path.backward:.2f} m backward), {path.cusps} changes of direction"
    print(f"route of {driven}{tightest}{first}")


def _draw(file: Path, world: "WorldMap", vehicle: "Vehicle", result: "RouteResult", name: str) -> None:
    """Draw map, route and footprints.

    Raises:
        NotInstalledError: matplotlib is not installed.
        InputError: the file cannot be written.
    """
    import numpy as np

    from monstertruck_planners.collision import Footprint
    from monstertruck_planners.route.motion import moved
    from monstertruckd.tools.figures import new_figure, write_figure

    width, height = world.size
    figure = new_figure(9, min(max(9 * height / width, 3), 14))
    from matplotlib.patches import Rectangle

    axis = figure.add_subplot()
    shades = np.select([world.cells < 0, world.cells >= 50], [0.75, 0.15], 1.0)
    x, y = world.origin
    axis.imshow(shades, origin="lower", cmap="gray", vmin=0, vmax=1, extent=(x, x + width, y, y + height))
    if result.path is not None:
        samples = result.path.sample(0.02)
        base = moved(samples.poses, -vehicle.reference)
        for direction, colour, label in ((1, "C0", "forward"), (-1, "C3", "backward")):
            own = np.where((samples.direction == direction)[:, None], base[:, :2], np.nan)
            if np.isfinite(own).any():
                axis.plot(own[:, 0], own[:, 1], colour, lw=1.5, label=label)
        footprint = Footprint()
        for px, py, yaw in base[:: max(len(base) // 40, 1)]:
            axis.add_patch(
                Rectangle(
                    (px - footprint.half_length, py - footprint.half_width),
                    2 * footprint.half_length, 2 * footprint.half_width, angle=math.degrees(yaw),
                    rotation_point=(px, py), fill=False, lw=0.5, color="0.4",
                )
            )  # fmt: skip
        axis.legend(loc="upper right")
        axis.set_title(f"{name}: {result.path.length:.2f} m, {result.path.cusps} changes of direction")
    elif result.poses is not None:
        base = moved(result.poses, -vehicle.reference)
        axis.plot(base[:, 0], base[:, 1], "C0", lw=1.5)
        axis.set_title(f"{name}: path over the grid")
    else:
        axis.set_title(f"{name}: {result.reason.text}")
    axis.set(xlabel="x, m", ylabel="y, m")
    write_figure(figure, file)
