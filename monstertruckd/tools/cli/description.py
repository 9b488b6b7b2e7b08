"""``monstertruckd description``: the robot as links and joints, for viewers and simulators."""

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from monstertruckd.tools.cli.options import ConfigArgument
from monstertruckd.tools.cli.output import needs_extra


class DescriptionFormat(StrEnum):
    """Of the file."""

    URDF = "urdf"
    MJCF = "mjcf"


def description(
    config: ConfigArgument,
    form: Annotated[DescriptionFormat, typer.Option("--format", "-f", help="Language of the file.")] = (
        DescriptionFormat.URDF
    ),
    output: Annotated[Path | None, typer.Option("--output", "-o", help="New file; default: standard output.")] = None,
) -> None:
    """Print the robot of a configuration as links, masses and joints, with the frames of its sensors.

    The same description is what engine `mujoco` simulates. Of an emulated robot masses and springs are those of its
    section `sim`.
    """
    from monstertruck_kinematics.description import urdf
    from monstertruckd.tools.simulation.config import load_robot
    from monstertruckd.tools.simulation.description import described, model_text

    robot, _ = load_robot(config)
    if form is DescriptionFormat.MJCF:
        with needs_extra("sim3d"):
            text = model_text(robot)
    else:
        text = urdf(described(robot))
    if output is None:
        print(text, end="")
    else:
        with output.open("x", encoding="utf-8") as file:
            file.write(text)
