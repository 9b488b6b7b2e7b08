"""Commands on single devices: emulate one on a pty, probe one on a port."""

import json
import sys
from pathlib import Path
from typing import Annotated, Any

import typer

from monstertruck_runtime.clock import Clock, run_wall

DeviceArgument = Annotated[
    str,
    typer.Argument(
        help="Kind or role: lidar, drive, steering, compass, stabiliser, camera; probe: battery, link, host."
    ),
]


def emulate(
    device: DeviceArgument,
    link: Annotated[Path, typer.Option("--link", "-l", help="Symlink to create for the pty.")],
    seed: Annotated[int, typer.Option(help="Seed of the device's noise.")] = 0,
) -> None:
    """Emulate one device, byte for byte, alone on a pty: for third-party clients and bench work.

    Faults are read from standard input, one per line: [b]unplug[/b], [b]plug[/b], [b]power-cycle[/b],
    [b]line stalled|deaf|delay|chunk|flip_rate|drop_rate|garbage VALUE[/b], or a fault of the device itself
    (an unknown word lists them).
    """
    from monstertruckd.sim.console import FaultConsole
    from monstertruckd.sim.single import emulate_device

    async def main(clock: Clock) -> None:
        async with emulate_device(device, link, clock, seed) as emulated:
            typer.echo(f"{device} on {link}; faults on standard input, Ctrl-C ends", err=True)
            await FaultConsole({device: emulated}, sys.stdin, typer.echo).run()

    run_wall(main)


def probe(
    device: DeviceArgument,
    port: Annotated[
        Path | None,
        typer.Option("--port", "-p", help="Device node, e.g. /dev/truck/lidar; of a camera also a pattern."),
    ] = None,
    baud: Annotated[int | None, typer.Option(help="Bits per second; default: the device's own.")] = None,
) -> None:
    """Handshake with a device and print its identity, state and first samples as JSON. Moves nothing."""
    from monstertruck_drivers.link import SerialPort
    from monstertruck_runtime.errors import InputError
    from monstertruckd.catalog import find_kind

    kind = find_kind(device)
    if kind.asked == "port" and port is None:
        raise InputError(f"{device}: say where it hangs with --port")
    if kind.asked == "machine" and port is not None:
        raise InputError(f"{device}: is the computer's own and hangs on no port; leave out --port")

    async def main(clock: Clock) -> dict[str, Any]:
        if port is None:
            return await kind.probe()()
        if kind.asked == "path":
            return await kind.probe()(str(port))
        return await kind.probe()(SerialPort(port, baud or kind.baud), clock)

    typer.echo(json.dumps(run_wall(main), indent=2, default=str))
