"""``monstertruckd station``: the operator's web page."""

import ssl
from pathlib import Path
from typing import Annotated

import typer

from monstertruck_runtime.errors import InputError
from monstertruck_schemas.roles import AccessRole
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
    host: Annotated[
        str, typer.Option("--host", help="Address to serve on; another than the loopback one needs the next three.")
    ] = "127.0.0.1",
    certificate: Annotated[
        Path | None, typer.Option("--certificate", help="Certificate of the page (PEM, with its chain).")
    ] = None,
    key: Annotated[Path | None, typer.Option("--key", help="Its private key (PEM).")] = None,
    users: Annotated[Path | None, typer.Option("--users", help="File of the users who may log in.")] = None,
    name: Annotated[
        list[str] | None, typer.Option("--name", help="Further name of this machine, in the page's address.")
    ] = None,
    add_user: Annotated[
        str | None,
        typer.Option("--add-user", metavar="USER", help="Add a user to --users, asking for a password; end."),
    ] = None,
    role: Annotated[AccessRole, typer.Option("--role", help="Of the added user.")] = AccessRole.PILOT,
) -> None:
    """Serve the operator's page on this machine: map, state, goals, driving, emergency stop.

    It is a client of the robots like any other, and asks nothing of the internet. Beyond the loopback
    interface the page is served by TLS only, and to users who log in.
    """
    from monstertruckd.recorder.reader import open_log
    from monstertruckd.station import users as station_users
    from monstertruckd.station.address import RobotAddress
    from monstertruckd.station.server import Place, Station

    if add_user is not None:
        if users is None:
            raise typer.BadParameter("--add-user needs --users FILE")
        password = typer.prompt(f"Password of {add_user}", hide_input=True, confirmation_prompt=True)
        station_users.add_user(users, add_user, role, password)
        return
    addresses = [RobotAddress.parse(text) for text in robots or ([] if routers else ["truck"])]
    known = None if users is None else station_users.StationUsers.load(users)
    place = Place(host, port, _tls(certificate, key), known, tuple(name or ()))
    until_stopped(
        lambda clock: Station(addresses, clock, place, routers or (), open_log).run(
            lambda: remark(f"station: {place.url}")
        )
    )


def _tls(certificate: Path | None, key: Path | None) -> ssl.SSLContext | None:
    """Of the page; TLS 1.2 at least.

    Raises:
        InputError: a file is missing, or they do not belong together.
    """
    if certificate is None and key is None:
        return None
    if certificate is None or key is None:
        raise InputError("expected --certificate and --key together")
    context = ssl.create_default_context(ssl.Purpose.CLIENT_AUTH)
    try:
        context.load_cert_chain(certificate, key)
    except (OSError, ssl.SSLError) as error:
        raise InputError(f"{certificate}, {key}: expected a certificate and its key (PEM): {error}") from None
    return context
