"""``monstertruckd station``: the operator's web page."""

from typing import Annotated

import typer

from monstertruckd.tools.cli.output import needs_extra, remark, until_stopped


@needs_extra("station")
def station(
    robots: Annotated[
        list[str] | None,
        typer.Option("--robot", "-r", metavar="NAME@ENDPOINT", help="Robot to show; may be repeated. Default: truck."),
    ] = None,
    routers: Annotated[
        list[str] | None,
        typer.Option("--router", metavar="ENDPOINT", help="Zenoh router whose robots are shown as they appear."),
    ] = None,
    port: Annotated[int, typer.Option("--port", "-p", min=1, max=65535, help="Port of the page.")] = 8470,
) -> None:
    """Serve the operator's page on this machine: map, state, goals, driving, emergency stop.

    It is a client of the robots like any other, and asks nothing of the internet. The page is served on the loopback
    interface only.
    """
    from monstertruckd.station.address import RobotAddress
    from monstertruckd.station.server import Place, Station

    addresses = [RobotAddress.parse(text) for text in robots or ([] if routers else ["truck"])]
    place = Place(port=port)
    until_stopped(
        lambda clock: Station(addresses, clock, place, routers or ()).run(lambda: remark(f"station: {place.url}"))
    )
