"""Commands on the USB tree: show it, and find out which port a cable is in."""

import sys
from pathlib import Path
from typing import Annotated

import typer

from monstertruck_runtime.endpoints import DEFAULT_ENDPOINT
from monstertruckd.tools.cli.connection import with_robot
from monstertruckd.tools.cli.options import EndpointOption, RobotOption, complete_role
from monstertruckd.tools.cli.output import JsonOption, console, on_terminal, print_json, print_table, remark


def usb(
    robot: RobotOption = "truck",
    endpoint: EndpointOption = DEFAULT_ENDPOINT,
    local: Annotated[bool, typer.Option("--local", help="Show this machine's USB tree, without a daemon.")] = False,
    json_output: JsonOption = False,
) -> None:
    """List USB hubs, ports and devices of a running robot, with role, state and replugs."""
    from monstertruck_runtime.clock import run_wall
    from monstertruckd.tools.cli.usb_tree import HEADINGS, draw, local_tree, robot_tree, rows

    nodes = (
        run_wall(local_tree)
        if local
        else with_robot(lambda client, _: robot_tree(client), robot, endpoint, named=False)
    )
    if json_output:
        print_json(nodes)
    elif not nodes:
        remark(
            "no USB hub on this machine" if local else f"robot {robot!r} has no USB hub; --local shows this machine's"
        )
    elif on_terminal(sys.stdout):
        console().print(*draw(nodes), sep="\n")
    else:
        print_table(HEADINGS, rows(nodes))


def find_port(
    role: Annotated[
        str,
        typer.Argument(help="Role of the device: lidar, drive, steering, compass ...", autocompletion=complete_role),
    ],
    write: Annotated[
        Path | None, typer.Option("--write", "-w", help="Configuration file to write the port to.")
    ] = None,
    wait: Annotated[float, typer.Option(min=0.1, help="Seconds to wait until the cable is unplugged.")] = 60.0,
    json_output: JsonOption = False,
) -> None:
    """Unplug the cable: this names its hub and port and prints the line for the configuration."""
    from monstertruck_drivers.computer import Machine
    from monstertruck_drivers.config import Devices
    from monstertruck_runtime.clock import run_wall
    from monstertruck_runtime.errors import InputError
    from monstertruckd.tools.cli.find_port import config_line, find_cable, require_place, write_port

    if role not in Devices.model_fields:
        raise InputError(f"no role {role!r}; known: {', '.join(Devices.model_fields)}")
    if write is not None:
        require_place(write, role)
    port = run_wall(lambda clock: find_cable(role, Machine(clock), remark, wait))
    if json_output:
        print_json({"role": role, "port": port})
    else:
        print(config_line(port))
    if write is not None:
        write_port(write, role, port)
        remark(f"written to {write}")
