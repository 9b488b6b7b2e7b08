"""Commands on single devices: emulate a device on a pty, probe a device on a port."""

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final

import typer

from monstertruck_runtime.extras import needs_extra
from monstertruck_schemas.reasons import Reason
from monstertruckd.tools.cli.options import complete_device
from monstertruckd.tools.cli.output import (
    JsonOption,
    finish,
    print_json,
    print_table,
    print_words,
    remark,
    until_stopped,
)

if TYPE_CHECKING:
    from monstertruck_runtime.clock import Clock

DeviceArgument = Annotated[
    str,
    typer.Argument(
        help="Kind or role: lidar, drive, steering, compass, stabiliser, camera; for probe also battery, link, host.",
        autocompletion=complete_device,
    ),
]

OWN_CLIENTS: Final = {
    "video": "this is not a video device: only this project's webcam driver, with `port: { path: ... }`, "
    "understands its protocol",
    "i2c": "this is not an I2C bus: only this project's drivers and `probe` understand its protocol",
}
"""Limits of an emulator's link, by the kind of port used by its driver."""


@needs_extra("sim")
def emulate(
    device: DeviceArgument,
    link: Annotated[
        Path | None,
        typer.Option("--link", "-l", help="Symlink to create for the pty; default: the port of the emulated truck."),
    ] = None,
    tcp: Annotated[
        str | None, typer.Option("--tcp", help="Serve on this TCP address instead, e.g. 127.0.0.1:10940.")
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the device's noise.")] = 0,
) -> None:
    """Emulate one device, byte for byte, on a pty or a network socket: for third-party clients and bench tests.

    Faults are read from standard input, one per line: `unplug`, `plug`, `power-cycle`,
    `line stalled|deaf|delay|chunk|flip_rate|drop_rate|garbage VALUE`, `signal NAME FAULT [VALUE]` for a false
    reading or a command that is not obeyed (`signal help` lists them), or a fault of the device itself (an unknown
    word lists them).
    """
    from monstertruck_drivers.catalog import DEVICES
    from monstertruck_drivers.tcp import parse_address
    from monstertruck_runtime.endpoints import emulated_ports
    from monstertruck_runtime.errors import InputError
    from monstertruck_sim.console import CommandedGroup, FaultConsole
    from monstertruckd.config.truck import ROBOT
    from monstertruckd.tools.simulation.emulate import emulate_device

    port: Path | tuple[str, int] = link or emulated_ports(ROBOT) / DEVICES.named(device).role.name
    if tcp is not None:
        if link is not None or (address := parse_address(tcp)) is None:
            raise InputError(f"--tcp {tcp}: expected an address such as 127.0.0.1:10940, and no --link")
        port = address

    async def main(clock: "Clock") -> None:
        async with emulate_device(device, port, clock, seed) as emulated:
            remark(f"{device} on {tcp or port}; enter faults on standard input, stop with Ctrl-C")
            if (limits := OWN_CLIENTS.get(DEVICES.named(device).opens)) is not None:
                remark(f"{device}: {limits}")
            await FaultConsole(CommandedGroup("device", {device: emulated}), sys.stdin, print_words).run()

    until_stopped(main)


@needs_extra("robot")
def probe(
    device: DeviceArgument,
    port: Annotated[
        Path | None,
        typer.Option("--port", "-p", help="Device node, or ADDRESS:PORT on the network; for a camera also a pattern."),
    ] = None,
    baud: Annotated[int | None, typer.Option(min=1, help="Bits per second; default: the device's default.")] = None,
    json_output: JsonOption = False,
) -> None:
    """Connect to a device and print its identity, state and first samples, without moving anything."""
    from monstertruck_drivers.catalog import DEVICES
    from monstertruck_drivers.computer import ROOT, Computer
    from monstertruck_drivers.i2c.port import I2cPort
    from monstertruck_drivers.link import BAUD
    from monstertruck_drivers.tcp import TcpPort, parse_address
    from monstertruck_drivers.tty import SerialPort
    from monstertruck_runtime.clock import run_wall
    from monstertruck_runtime.errors import InputError, NotFoundError

    kind = DEVICES.named(device)
    if kind.opens in ("serial", "i2c") and port is None:
        raise InputError(f"{device}: pass its port with --port")
    if kind.opens == "computer" and port is not None:
        raise InputError(f"{device}: is part of the computer and has no port; omit --port")

    async def main(clock: "Clock") -> dict[str, Any]:
        where: Any = Computer.at(ROOT, clock)
        if kind.opens == "video":
            where = str(port or "/dev/video*")
        elif kind.opens == "i2c" and port is not None:
            where = I2cPort(port)
        elif port is not None and (address := parse_address(str(port))) is not None:
            where = TcpPort(*address)
        elif port is not None:
            where = SerialPort(port, baud or kind.baud or BAUD, framing=kind.framing or "8N1")
        return await kind.identify(where, clock)

    report = run_wall(main)
    found = [entry for entries in report.values() if isinstance(entries, list) for entry in entries]
    if kind.opens == "video" and port is not None and not found:
        raise NotFoundError(f"{port}: no such {kind.role.name}")
    if json_output:
        print_json(report)
    else:
        print_table(("what", "value"), list(_rows(report, "")))
    errors = [entry["error"] for entry in found if isinstance(entry, dict) and "error" in entry]
    if errors and len(errors) == len(found):
        finish(Reason.DEVICE_FAULT, "\n".join(errors))


def _rows(value: Any, name: str) -> Iterator[tuple[str, str]]:
    """Flatten a report to single values with dotted names."""
    if isinstance(value, dict) and value:
        for key, inner in value.items():
            yield from _rows(inner, f"{name}.{key}" if name else str(key))
    elif isinstance(value, list | tuple) and any(isinstance(inner, dict | list | tuple) for inner in value):
        for index, inner in enumerate(value):
            yield from _rows(inner, f"{name}.{index}")
    elif isinstance(value, list | tuple):
        yield name, ", ".join(map(str, value)) or "-"
    else:
        yield name, "-" if value is None else str(value)
