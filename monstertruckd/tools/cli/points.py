"""``monstertruckd points``: points of interest in the map: list, export, go to, mark, remove."""

import csv
import io
import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final

import typer

from monstertruck_runtime.endpoints import DEFAULT_ENDPOINT
from monstertruck_runtime.errors import InputError, NoAnswerError, NotFoundError
from monstertruckd.tools.cli.connection import not_ready, require_section, with_robot
from monstertruckd.tools.cli.goto import ROUTE_TIMEOUT, ArmOption
from monstertruckd.tools.cli.options import HEADING, EndpointOption, RobotOption, parse_heading, require_finite
from monstertruckd.tools.cli.output import JsonOption, command_group, print_end, print_json, print_table, remark

if TYPE_CHECKING:
    from monstertruck_runtime.client import TruckClient
    from monstertruck_runtime.clock import Clock
    from monstertruck_runtime.drives import Arrival
    from monstertruck_schemas.points import PointOfInterest, PointOrder

app = command_group("Points of interest in the map: tags found by the camera, and places marked by operators.")

NameArgument = Annotated[str, typer.Argument(help="Name of the point, such as tag-7 or dock.", show_default=False)]
MapOption = Annotated[
    Path | None, typer.Option("--map", help="Folder of a saved map, instead of a robot.", show_default=False)
]
WITHOUT = "keeps no points of interest"
FORMATS: Final = (".csv", ".geojson", ".yaml")
COLUMNS: Final = ("name", "kind", "tag", "x_m", "y_m", "z_m", "yaw_rad", "sigma_m", "sigma_yaw_rad", "sightings")


@app.command("list")
def list_command(
    map_folder: MapOption = None,
    robot: RobotOption = "truck",
    endpoint: EndpointOption = DEFAULT_ENDPOINT,
    json_output: JsonOption = False,
) -> None:
    """Print all points of interest."""
    points = _points(map_folder, robot, endpoint)
    if json_output:
        print_json([point.model_dump(mode="json") for point in points])
    elif points:
        numbers = ("x m", "y m", "yaw rad", "sigma cm", "seen")
        print_table(("name", *numbers), [row_of(point) for point in points], right=numbers)
    else:
        print("none")


@app.command("export")
def export_command(
    file: Annotated[Path, typer.Argument(help="File name ending with .csv, .geojson or .yaml.", show_default=False)],
    map_folder: MapOption = None,
    robot: RobotOption = "truck",
    endpoint: EndpointOption = DEFAULT_ENDPOINT,
) -> None:
    """Write all points of interest to a file; its extension sets the format."""
    from monstertruck_runtime.small_files import replace_file

    if file.suffix not in FORMATS:
        raise InputError(f"{file}: expected a name that ends with one of {', '.join(FORMATS)}")
    points = _points(map_folder, robot, endpoint)
    replace_file(file, text_of(points, file.suffix))
    remark(f"wrote {len(points)} points to {file}")


@app.command("goto")
def goto_command(
    name: NameArgument,
    distance: Annotated[float, typer.Option(min=0.0, max=5.0, help="Metres before a tag, facing it.")] = 0.7,
    arm: ArmOption = False,
    robot: RobotOption = "truck",
    endpoint: EndpointOption = DEFAULT_ENDPOINT,
    json_output: JsonOption = False,
) -> None:
    """Drive to a marked place, or in front of a tag. Ctrl-C cancels the goal."""
    from monstertruck_runtime.drives import drive_to
    from monstertruckd.tools.cli.goto_session import on_the_terminal

    async def main(client: "TruckClient", clock: "Clock") -> "Arrival":
        named = {point.name: point for point in await _newest(client, clock)}
        if name not in named:
            known = f"expected one of {', '.join(named)}" if named else "none is known"
            raise NotFoundError(f"no point of interest {name!r}: {known}")
        pose = named[name].before(distance)
        with on_the_terminal() as report:
            return await drive_to(client, clock, (pose.x, pose.y, pose.yaw), [], arm=arm, report=report)

    end = with_robot(main, robot, endpoint, ROUTE_TIMEOUT)
    print_end(end.reason, end.text, end.as_json(), json_output=json_output)


@app.command("mark", context_settings={"ignore_unknown_options": True})
def mark_command(
    name: NameArgument,
    x: Annotated[
        float | None, typer.Argument(help="Position, metres; default: the robot's.", show_default=False)
    ] = None,
    y: Annotated[float | None, typer.Argument(help="Metres.", show_default=False)] = None,
    yaw: Annotated[
        float | None,
        typer.Argument(parser=parse_heading, help=f"{HEADING} Default: the robot's.", show_default=False),
    ] = None,
    robot: RobotOption = "truck",
    endpoint: EndpointOption = DEFAULT_ENDPOINT,
) -> None:
    """Mark a place by name, at the robot's pose or at x y in the map; moves an existing place."""
    from monstertruck_schemas.points import PointOrder

    if (x is None) is not (y is None):
        raise InputError("expected x and y, or neither")
    require_finite(tuple(value for value in (x, y, yaw) if value is not None))
    place = None if x is None or y is None else (x, y)
    marked = _order(PointOrder.MARK, robot, endpoint, name, place, yaw)
    heading = math.degrees(marked["yaw"])
    remark(f"marked {name} at x {marked['x']:.2f}, y {marked['y']:.2f} m, heading {heading:z.1f} degrees")


@app.command("remove")
def remove_command(
    name: NameArgument, robot: RobotOption = "truck", endpoint: EndpointOption = DEFAULT_ENDPOINT
) -> None:
    """Remove a point of interest."""
    from monstertruck_schemas.points import PointOrder

    _order(PointOrder.REMOVE, robot, endpoint, name)
    remark(f"removed {name}")


def _points(folder: Path | None, robot: str, endpoint: str) -> "list[PointOfInterest]":
    if folder is not None:
        from monstertruck_estimation.points.files import FILE, load

        if not (points := [point for point, _ in load(folder)]):
            raise NotFoundError(f"{folder}: no {FILE} in it")
        return points
    return with_robot(_newest, robot, endpoint, named=False)


def _order(order: "PointOrder", robot: str, endpoint: str, *what: Any) -> dict[str, Any]:
    async def main(client: "TruckClient", _: "Clock") -> dict[str, Any]:
        await require_section(client, "points", WITHOUT)
        return await client.point(order, *what)

    return with_robot(main, robot, endpoint)


async def _newest(client: "TruckClient", clock: "Clock") -> "list[PointOfInterest]":
    from monstertruck_runtime.mailbox import latest
    from monstertruck_schemas.topics import POINTS

    await require_section(client, "points", WITHOUT)
    wait = 3.0  # timeout for the robot's list (s)
    with client.subscribe(POINTS, latest()) as box:
        try:
            async with clock.deadline(wait):
                return list((await box.next()).points)
        except TimeoutError:
            text = f"no list of points of interest within {wait:g} s"
            raise NoAnswerError(text + await not_ready(client)) from None


def row_of(point: "PointOfInterest") -> tuple[str, ...]:
    """Return name and numbers for a table."""
    from monstertruck_schemas.base import position_deviation

    place = (f"{value:z.2f}" for value in (point.x, point.y, point.yaw))
    return point.name, *place, f"{100 * position_deviation(point.covariance):.1f}", str(point.sightings)


def values_of(point: "PointOfInterest") -> dict[str, Any]:
    """Exported values, by ``COLUMNS``."""
    from monstertruck_schemas.base import position_deviation

    yaw_sigma = math.sqrt(float(point.covariance[8]))
    numbers = (point.x, point.y, point.z, point.yaw, position_deviation(point.covariance), yaw_sigma)
    values = (point.name, point.kind.value, point.tag, *(round(number, 4) for number in numbers), point.sightings)
    return dict(zip(COLUMNS, values, strict=True))


def text_of(points: Sequence["PointOfInterest"], ending: str) -> str:
    """Format points as one of ``FORMATS``; GeoJSON has coordinates in the map's metres."""
    from monstertruck_runtime.yaml_files import yaml_text

    rows = [values_of(point) for point in points]
    if ending == ".csv":
        out = io.StringIO()
        writer = csv.DictWriter(out, COLUMNS, lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
        return out.getvalue()
    if ending == ".yaml":
        return yaml_text({"frame": "map", "points": rows})
    features = [
        {
            "type": "Feature",
            "geometry": {"type": "Point", "coordinates": [row["x_m"], row["y_m"], row["z_m"]]},
            "properties": {name: value for name, value in row.items() if name not in ("x_m", "y_m", "z_m")},
        }
        for row in rows
    ]
    return json.dumps({"type": "FeatureCollection", "features": features}, indent=1) + "\n"
