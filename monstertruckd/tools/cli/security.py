"""Commands on certificates: who may connect to a robot, and what each may do there."""

import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.roles import AccessRole
from monstertruckd.tools.cli.output import JsonOption, command_group, finish, print_json, print_table, remark

if TYPE_CHECKING:
    from monstertruckd.tools.security.folder import Folder

app = command_group("Certificates: an authority, the stations that may connect to the robot, and their rights.")

FolderOption = Annotated[
    Path, typer.Option("--folder", "-f", help="Folder of the authority; keep it off the robot.", show_default=False)
]
HERE = Path("security")
NameArgument = Annotated[
    str, typer.Argument(help="Name of the station: letters, digits and . _ - @, not starting with . or @.")
]
RESTART = (
    "Takes effect once these files are on the robot and its daemon has been restarted; restart it while "
    "the robot stands."
)


@app.command("init")
def init(
    robot: Annotated[str | None, typer.Option("--robot", "-r", help="Name of the robot; default: truck.")] = None,
    address: Annotated[
        list[str] | None,
        typer.Option(
            "--address", "-a", help="Address or host name that stations connect to; default: this computer's."
        ),
    ] = None,
    place: Annotated[Path | None, typer.Option(help="Folder of these files on the robot.")] = None,
    days: Annotated[int, typer.Option(min=1, help="Validity of the robot's certificate.")] = 825,
    folder: FolderOption = HERE,
) -> None:
    """Make an authority and the robot's certificate and configuration; again: renew the robot's certificate.

    Options that are not given keep their values.
    """
    kept = _folder(folder)
    new = kept.init(robot, tuple(address) if address else None, place, _now(), days)
    print(f"{'authority made' if new else 'certificate of the robot renewed'} in {folder}")
    _say_robot(kept)


@app.command("add")
def add(
    name: NameArgument,
    role: Annotated[AccessRole | None, typer.Option(help="Role; default for a new station: pilot.")] = None,
    rank: Annotated[
        Literal["gamepad", "keyboard", "station"] | None,
        typer.Option(help="Highest priority it may claim; default for a new station: station."),
    ] = None,
    days: Annotated[int, typer.Option(min=1, help="Validity of its certificate.")] = 365,
    folder: FolderOption = HERE,
) -> None:
    """Certify a station; again: renew its certificate. Role and rank that are not given stay as they were."""
    from monstertruck_schemas.req import Role

    kept = _folder(folder)
    changed = kept.add(name, role, None if rank is None else Role(rank), _now(), days)
    target = kept.path / "stations" / name
    station = kept.register().stations[name]
    print(f"{name}: {station.role.value}, rank {station.rank.value}, {days} days; its files: {target}")
    remark(f"Copy to the station, into ~/.config/monstertruckd/tls: {shlex.quote(str(target))}/*")
    if changed:
        _say_robot(kept)
    else:
        remark("The robot needs no new files: it already trusts the issuer.")


@app.command("show")
def show(folder: FolderOption = HERE, json_output: JsonOption = False) -> None:
    """Everything that is certified, with the days until it expires. Ends with code 12 if something has expired."""
    rows = _folder(folder).certificates(_now())
    if json_output:
        print_json([{"name": r.name, "role": r.role, "rank": r.rank, "days": r.days} for r in rows])
    else:
        cells = [(row.name, row.role, row.rank, "not here" if row.days is None else str(row.days)) for row in rows]
        print_table(("name", "role", "rank", "days left"), cells, right=("days left",))
    expired = [row.name for row in rows if row.days is not None and row.days < 0]
    finish(Reason.NOT_PERMITTED if expired else Reason.OK, f"expired: {', '.join(expired)}")


@app.command("revoke")
def revoke(name: NameArgument, folder: FolderOption = HERE) -> None:
    """Forget a station: after the robot's next start its certificate opens no link."""
    kept = _folder(folder)
    kept.revoke(name)
    print(f"{name} revoked")
    _say_robot(kept)


@app.command("rules")
def rules(folder: FolderOption = HERE) -> None:
    """Print the access rules that follow for each of the robot's Zenoh sessions, as Zenoh reads them."""
    from monstertruckd.bus.access import access_rules
    from monstertruckd.bus.zenoh_config import listeners

    kept = _folder(folder)
    robot = kept.register().robot
    print_json(
        [
            {"listen": listener.listen, "access_control": access_rules(robot, listener.grants, listener.routers)}
            for listener in listeners(kept.zenoh())
        ]
    )


@app.command("router")
def router(
    robots: Annotated[list[Path], typer.Argument(help="Folders of the authorities of the fleet's robots.")],
    address: Annotated[
        list[str],
        typer.Option("--address", "-a", help="Address or host name of the router; robots connect to the first."),
    ],
    place: Annotated[Path | None, typer.Option(help="Folder of these files on the router.")] = None,
    port: Annotated[int, typer.Option(min=1, max=65535, help="Port to listen on.")] = 7447,
    folder: Annotated[
        Path, typer.Option("--folder", "-f", help="Folder of the router's authority.", show_default=False)
    ] = Path("router-security"),
) -> None:
    """Certificate, access rules and configuration of a fleet's router; its robots and their stations trust it then.

    Again after a robot or a station is added: the router reads its rules at its start.
    """
    from monstertruckd.tools.security.router import PLACE, make_router

    kept = [_folder(path) for path in robots]
    make_router(folder, kept, address, _now(), place or PLACE, port)
    print(f"router of {', '.join(each.register().robot for each in kept)}: its files: {folder / 'router'}")
    remark(
        f"Copy to the router, into {place or PLACE}: {shlex.quote(str(folder / 'router'))}/*; start it with zenoh.json5"
    )
    remark("Copy their folders to every robot and station again, so that they trust the router.")


@app.command("check")
def check(
    endpoint: Annotated[str, typer.Option("--endpoint", "-e", help="Address of the running robot: tls/HOST:PORT.")],
    folder: FolderOption = HERE,
    json_output: JsonOption = False,
) -> None:
    """Try a running robot as pilot, observer, stranger, under another name, and without TLS; list expiries.

    Nothing moves. Ends with code 12 if one of them gets more or less than it should.
    """
    from monstertruck_runtime.clock import run_wall
    from monstertruckd.tools.security.check import check as tried

    cases = run_wall(lambda clock: tried(_folder(folder), endpoint, clock))
    if json_output:
        print_json([{"who": c.who, "expected": c.expected, "found": c.found, "met": c.met} for c in cases])
    else:
        print_table(
            ("who", "found", ""), [(c.who, c.found, "ok" if c.met else f"expected {c.expected}") for c in cases]
        )
    failed = [case.who for case in cases if not case.met]
    finish(Reason.NOT_PERMITTED if failed else Reason.OK, f"wrong: {', '.join(failed)}")


def _folder(path: Path) -> "Folder":
    from monstertruckd.tools.security.folder import Folder

    return Folder(path)


def _now() -> int:
    from monstertruck_runtime.clock import SECOND, WallClock

    clock = WallClock()
    return (clock.now() + clock.real_offset()) // SECOND


def _say_robot(folder: "Folder") -> None:
    register = folder.register()
    place = register.place
    remark(
        f"Copy to the robot, into {place} (robot.key readable by its daemon alone): {shlex.quote(str(folder.robot))}/*"
    )
    remark(f"The robot's configuration needs `include: {place}/zenoh.yaml`. {RESTART}")
    if register.router is not None:
        remark("The router uses its old rules until `security router` is run again and it is restarted.")
    if not register.of_role(AccessRole.PILOT, AccessRole.ENGINEER):
        remark("The robot does not start with these files, because no station could drive it.")
        remark("Next: monstertruckd security add NAME --role pilot")
