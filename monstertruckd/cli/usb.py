"""Commands on the USB tree: show it, and find out which port a cable is in."""

import json
import sys
from pathlib import Path
from typing import Annotated

import typer

from monstertruck_runtime.clock import run_wall
from monstertruckd.cli.options import ENDPOINT, EndpointOption, RobotOption


def usb(
    robot: RobotOption = "truck",
    endpoint: EndpointOption = ENDPOINT,
    local: Annotated[bool, typer.Option("--local", help="This machine's own tree, without a daemon.")] = False,
    json_output: Annotated[bool, typer.Option("--json", help="Machine-readable output.")] = False,
) -> None:
    """USB hubs, ports and devices of a running robot: what hangs where, its role, state and replugs."""
    from monstertruckd.cli.usb_tree import draw, local_tree, plain, robot_tree

    nodes = run_wall(local_tree if local else lambda clock: robot_tree(clock, robot, endpoint))
    if json_output:
        print(json.dumps([node.model_dump(mode="json") for node in nodes], indent=2))
    elif sys.stdout.isatty():
        from rich.console import Console

        Console().print(*draw(nodes), sep="\n")
    else:
        print("\n".join(plain(nodes)))


def find_port(
    role: Annotated[str, typer.Argument(help="Role of the device: lidar, drive, steering, compass ...")],
    write: Annotated[
        Path | None, typer.Option("--write", "-w", help="Configuration file to put the port into.")
    ] = None,
    wait: Annotated[float, typer.Option(help="Seconds to wait for the cable.")] = 60.0,
) -> None:
    """Unplug the cable: this names its hub and port and prints the line for the configuration."""
    from monstertruck_drivers.usb.machine import Machine
    from monstertruckd.cli.find_port import config_line, find_cable, write_port

    def say(text: str) -> None:
        typer.echo(text, err=True)

    port = run_wall(lambda clock: find_cable(role, Machine(clock), say, wait))
    typer.echo(config_line(port))
    if write is not None:
        write_port(write, role, port)
        say(f"written to {write}")
