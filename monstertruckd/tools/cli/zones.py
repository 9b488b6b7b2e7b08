"""``monstertruckd zone``: keepout and speed zones of the map: list, add, remove, turn off for a while."""

from typing import TYPE_CHECKING, Annotated, Final, Literal

import typer

from monstertruck_runtime.endpoints import DEFAULT_ENDPOINT
from monstertruck_runtime.errors import InputError, NoAnswerError
from monstertruckd.tools.cli.connection import not_ready, require_section, with_robot
from monstertruckd.tools.cli.model_options import seconds_of
from monstertruckd.tools.cli.options import EndpointOption, RobotOption
from monstertruckd.tools.cli.output import JsonOption, command_group, print_json, print_table, remark

if TYPE_CHECKING:
    from monstertruck_runtime.client import TruckClient
    from monstertruck_runtime.clock import Clock
    from monstertruck_schemas.zones import Zone, ZoneArea, ZoneOrder, Zones

app = command_group("Keepout and speed zones of the map.")

NameArgument = Annotated[str, typer.Argument(help="Name of the zone, such as stairs.", show_default=False)]
WITHOUT: Final = "keeps no zones"


@app.command("list")
def list_command(
    robot: RobotOption = "truck", endpoint: EndpointOption = DEFAULT_ENDPOINT, json_output: JsonOption = False
) -> None:
    """Print all zones, those that are off, and those that the robot is in."""

    async def main(client: "TruckClient", clock: "Clock") -> "tuple[Zones, int]":
        from monstertruck_runtime.mailbox import latest
        from monstertruck_schemas.topics import GATE, ZONES

        await require_section(client, "zones", WITHOUT)
        wait = 3.0  # seconds to wait for the robot's list
        with client.subscribe(ZONES, latest()) as box, client.subscribe(GATE, latest()) as gate:
            try:
                async with clock.deadline(wait):
                    return await box.next(), (await gate.next()).stamp
            except TimeoutError:
                text = f"no list of zones received within {wait:g} s"
                raise NoAnswerError(text + await not_ready(client)) from None

    known, now = with_robot(main, robot, endpoint, named=False)
    if json_output:
        print_json(known.model_dump(mode="json", include={"zones", "inside"}))
    elif known.zones:
        rows = [row_of(zone, inside=zone.name in known.inside, now=now) for zone in known.zones]
        print_table(("name", "kind", "limit m/s", "inside", "ground", "made by", "state"), rows, right=("limit m/s",))
    else:
        print("none")


@app.command("add", context_settings={"ignore_unknown_options": True})
def add_command(
    name: NameArgument,
    corners: Annotated[
        list[str], typer.Argument(metavar="X,Y...", help="Corners in the map, metres.", show_default=False)
    ],
    limit: Annotated[
        float | None, typer.Option("--limit", help="Maximum speed (m/s): a speed zone.", show_default=False)
    ] = None,
    leave: Annotated[
        bool,
        typer.Option("--leave", help="A robot inside drives out slowly instead of standing still.", show_default=False),
    ] = False,
    robot: RobotOption = "truck",
    endpoint: EndpointOption = DEFAULT_ENDPOINT,
) -> None:
    """Add a keepout zone, or with --limit a speed zone; one that an operator made is replaced."""
    from monstertruck_schemas.zones import ZoneOrder

    _order(ZoneOrder.ADD, robot, endpoint, name, area_of(corners, limit, "leave" if leave else "stop"))
    remark(f"added {name}")


@app.command("remove")
def remove_command(
    name: NameArgument, robot: RobotOption = "truck", endpoint: EndpointOption = DEFAULT_ENDPOINT
) -> None:
    """Remove a zone that an operator made."""
    from monstertruck_schemas.zones import ZoneOrder

    _order(ZoneOrder.REMOVE, robot, endpoint, name)
    remark(f"removed {name}")


@app.command("off")
def off_command(
    name: NameArgument,
    duration: Annotated[str, typer.Option("--for", help="Duration, at most 24h.", metavar="TIME")] = "10min",
    robot: RobotOption = "truck",
    endpoint: EndpointOption = DEFAULT_ENDPOINT,
) -> None:
    """Turn a zone off for a while; a restart of the robot turns it on again."""
    from monstertruck_schemas.zones import LONGEST_OFF, ZoneOrder

    seconds = seconds_of(duration)
    if seconds > LONGEST_OFF:
        raise InputError(f"duration {duration!r}: expected at most {LONGEST_OFF / 3600:g}h")
    _order(ZoneOrder.OFF, robot, endpoint, name, None, seconds)
    remark(f"{name} is off for {seconds:g} s")


@app.command("on")
def on_command(name: NameArgument, robot: RobotOption = "truck", endpoint: EndpointOption = DEFAULT_ENDPOINT) -> None:
    """Turn a zone on again."""
    from monstertruck_schemas.zones import ZoneOrder

    _order(ZoneOrder.ON, robot, endpoint, name)
    remark(f"{name} is on")


def _order(
    order: "ZoneOrder", robot: str, endpoint: str, name: str, area: "ZoneArea | None" = None, *seconds: float
) -> None:
    async def main(client: "TruckClient", _: "Clock") -> None:
        await require_section(client, "zones", WITHOUT)
        await client.zone(order, name, area, *seconds)

    with_robot(main, robot, endpoint)


def area_of(corners: list[str], limit: float | None, inside: Literal["stop", "leave"]) -> "ZoneArea":
    """Polygon of a command line.

    Raises:
        InputError: fewer than three corners, a corner without x,y, or an impossible zone.
    """
    from pydantic import ValidationError

    from monstertruck_schemas.base import first_mistake
    from monstertruck_schemas.zones import ZoneArea

    places = []
    for corner in corners:
        try:
            x, y = map(float, corner.split(","))
        except ValueError:
            raise InputError(f"corner {corner!r}: expected x,y in metres") from None
        places.append((x, y))
    kind: Literal["keepout", "speed"] = "keepout" if limit is None else "speed"
    try:
        return ZoneArea(kind=kind, corners=tuple(places), limit=limit, inside=inside)
    except ValidationError as error:
        raise InputError(first_mistake(error)) from None


def row_of(zone: "Zone", *, inside: bool, now: int) -> tuple[str, ...]:
    """Row of a table; ``now`` is the robot's time (ns)."""
    from monstertruck_runtime.clock import SECOND

    if zone.mask is None:
        ground = f"{len(zone.corners)} corners"
    else:
        ground = f"mask, {zone.mask.width} x {zone.mask.height} cells"
    limit = "" if zone.limit is None else f"{zone.limit:g}"
    off = "on" if zone.off_until is None else f"off for {max(zone.off_until - now, 0) / SECOND:.0f} s"
    state = f"{off}, robot inside" if inside else off
    maker = "operator" if zone.saved else "configuration"
    return zone.name, zone.kind, limit, zone.inside if zone.kind == "keepout" else "", ground, maker, state
