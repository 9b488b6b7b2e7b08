"""``monstertruckd station``: the operator's web page."""

from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from monstertruck_runtime.endpoints import is_endpoint
from monstertruck_runtime.errors import InputError
from monstertruck_runtime.extras import needs_extra
from monstertruck_schemas.roles import AccessRole
from monstertruckd.tools.cli.output import remark, until_stopped

if TYPE_CHECKING:
    from ssl import SSLContext

    from monstertruck_runtime.clock import WallClock
    from monstertruckd.station.address import RobotAddress


@needs_extra("station")
def station(
    robots: Annotated[
        list[str] | None,
        typer.Option(
            "--robot",
            "-r",
            metavar="NAME@ENDPOINT",
            help="Robot to show; may be repeated. Default: the robot of this computer.",
        ),
    ] = None,
    routers: Annotated[
        list[str] | None,
        typer.Option("--router", metavar="ENDPOINT", help="Zenoh router whose robots are shown as they appear."),
    ] = None,
    port: Annotated[int, typer.Option("--port", "-p", min=1, max=65535, help="Port of the page.")] = 8470,
    host: Annotated[
        str,
        typer.Option(
            "--host", help="Address to serve on; an address other than loopback needs the next three options."
        ),
    ] = "127.0.0.1",
    certificate: Annotated[
        Path | None, typer.Option("--certificate", help="Certificate of the page (PEM, with its chain).")
    ] = None,
    key: Annotated[Path | None, typer.Option("--key", help="Its private key (PEM).")] = None,
    users: Annotated[Path | None, typer.Option("--users", help="File of the users who may log in.")] = None,
    name: Annotated[
        list[str] | None, typer.Option("--name", help="Additional host name of this machine in the page's URL.")
    ] = None,
    add_user: Annotated[
        str | None,
        typer.Option("--add-user", metavar="USER", help="Add a user to --users, ask for the password, and exit."),
    ] = None,
    role: Annotated[AccessRole, typer.Option("--role", help="Role of the added user.")] = AccessRole.PILOT,
    foxglove: Annotated[
        bool, typer.Option("--foxglove", help="Also serve the first robot to Foxglove's app on this machine.")
    ] = False,
    foxglove_port: Annotated[int, typer.Option("--foxglove-port", min=1, max=65535, help="Port for Foxglove.")] = 8765,
    foxglove_drive: Annotated[
        bool,
        typer.Option(
            "--foxglove-drive", help="Let Foxglove drive and arm; any page in a browser on this machine could, too."
        ),
    ] = False,
    rerun: Annotated[
        bool, typer.Option("--rerun", help="Also show the first robot in a running rerun viewer on this machine.")
    ] = False,
) -> None:
    """Serve the operator's page on this machine: map, state, goals, driving, emergency stop.

    It is a client of the robots like any other, and needs no internet connection. Beyond the loopback
    interface the page is served by TLS only, and to users who log in.
    """
    import asyncio

    from monstertruckd.recorder.reader import open_log
    from monstertruckd.station import users as station_users
    from monstertruckd.station.address import RobotAddress
    from monstertruckd.station.server import Place, Station
    from monstertruckd.tools.cli.calibrate_page import PageCalibrator

    if add_user is not None:
        if users is None:
            raise typer.BadParameter("--add-user needs --users FILE")
        password = typer.prompt(f"Password of {add_user}", hide_input=True, confirmation_prompt=True)
        station_users.add_user(users, add_user, role, password)
        return
    for router in routers or ():
        if not is_endpoint(router):
            raise InputError(f"--router {router!r}: expected tcp/HOST:PORT or tls/HOST:PORT")
    addresses = [RobotAddress.parse(text) for text in robots or ()]
    if not robots and not routers:
        addresses = [RobotAddress.default()]
    known = None if users is None else station_users.StationUsers(users)
    place = Place(host, port, _tls(certificate, key), known, tuple(name or ()))
    if (foxglove or foxglove_drive or rerun) and not addresses:
        raise typer.BadParameter("a viewer shows one robot: pass --robot NAME@ENDPOINT")

    async def serve(clock: "WallClock") -> None:
        page = Station(addresses, clock, place, routers or (), open_log, calibrator=PageCalibrator(clock))
        jobs = [page.run(lambda: remark(f"station: {place.url}"))]
        if foxglove or foxglove_drive:
            jobs.append(_foxglove(addresses[0], clock, foxglove_port, drives=foxglove_drive))
        if rerun:
            jobs.append(_rerun(addresses[0], clock))
        await asyncio.gather(*jobs)

    until_stopped(serve)


async def _foxglove(address: "RobotAddress", clock: "WallClock", port: int, *, drives: bool) -> None:
    with needs_extra("viewers"):
        from monstertruckd.station.foxglove import LAYOUT, FoxgloveServer

        server = FoxgloveServer(address, clock, port, drives=drives)
    await server.run(lambda: remark(f"Foxglove: ws://127.0.0.1:{server.port}, layout {LAYOUT}"))


async def _rerun(address: "RobotAddress", clock: "WallClock") -> None:
    from monstertruckd.tools.logs.live_process import VIEWER, show_live

    with needs_extra("viewers"):
        if find_spec("rerun") is None:
            raise ModuleNotFoundError(name="rerun")
    remark(f"rerun: {VIEWER}")
    await show_live(address.name, address.endpoint, clock)


def _tls(certificate: Path | None, key: Path | None) -> "SSLContext | None":
    """TLS context of the page; TLS 1.2 at least.

    Raises:
        InputError: a file is missing, or they do not belong together.
    """
    import ssl

    if certificate is None and key is None:
        return None
    if certificate is None or key is None:
        raise InputError("pass --certificate and --key together")
    context = ssl.create_default_context(ssl.Purpose.CLIENT_AUTH)
    try:
        context.load_cert_chain(certificate, key)
    except (OSError, ssl.SSLError) as error:
        raise InputError(f"{certificate}, {key}: expected a certificate and its key (PEM): {error}") from None
    return context
