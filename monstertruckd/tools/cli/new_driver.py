"""``monstertruckd new-driver``: a driver's package with emulator and tests."""

from pathlib import Path
from typing import Annotated

import typer

from monstertruckd.tools.cli.output import remark
from monstertruckd.tools.new_driver.write import DriverKind, write_driver


def new_driver(
    kind: Annotated[
        DriverKind, typer.Argument(help="lidar: streams; sensor: answers; motors: drives shafts.", show_default=False)
    ],
    name: Annotated[str, typer.Argument(help="Name of the device kind, such as acme_l5.", show_default=False)],
    folder: Annotated[Path, typer.Option("--folder", help="Where its folder is made.")] = Path(),
) -> None:
    """Write the package of a new driver: protocol, driver, emulator, identity, tests. Its tests pass as written.

    Replace the protocol by the device's own, then emulator and tests. Existing files are never overwritten.
    """
    made = write_driver(kind, name, folder)
    remark(f"written: {made}; next:")
    print(
        f"cd {made}\npython -m pytest\npython -m hatchling build -t wheel -d dist\n"
        f"python -m zipfile -e dist/{name}_driver-0.1-py3-none-any.whl plugins\n"
        "PYTHONPATH=plugins monstertruckd plugins"
    )
