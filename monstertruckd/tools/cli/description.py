"""``monstertruckd description``: the robot as links and joints, for viewers and simulators."""

from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from monstertruck_runtime.errors import InputError
from monstertruck_runtime.extras import needs_extra
from monstertruckd.tools.cli.options import ConfigArgument
from monstertruckd.tools.cli.output import remark

if TYPE_CHECKING:
    from monstertruck_kinematics.description import Description, Mechanics
    from monstertruck_sim.world.config import SimTruckConfig
    from monstertruckd.config.truck import TruckConfig


class DescriptionFormat(StrEnum):
    """Format of the file."""

    URDF = "urdf"
    MJCF = "mjcf"


def description(
    config: ConfigArgument,
    form: Annotated[DescriptionFormat, typer.Option("--format", "-f", help="Output format.")] = (
        DescriptionFormat.URDF
    ),
    output: Annotated[Path | None, typer.Option("--output", "-o", help="New file; default: standard output.")] = None,
) -> None:
    """Print the robot of a configuration as links, masses and joints, with the frames of its sensors.

    Engine `mujoco` simulates the same description. Masses and springs of an emulated robot come from its section `sim`.
    """
    from monstertruck_kinematics.description import urdf
    from monstertruckd.tools.simulation.config import load_robot

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


def import_urdf(
    file: Annotated[Path, typer.Argument(help="URDF of a four-wheeled robot.", show_default=False)],
    links: Annotated[
        list[str] | None,
        typer.Option("--link", help="URDF link of a device, e.g. lidar=base_scan.", show_default=False),
    ] = None,
    output: Annotated[Path | None, typer.Option("--output", "-o", help="New file; default: standard output.")] = None,
) -> None:
    """Print geometry and sensor mounts of a robot's own URDF as sections of a configuration.

    Lidar, camera and IMU are found by the names of their links.
    """
    from monstertruck_runtime.yaml_files import yaml_text
    from monstertruckd.tools.urdf import SENSORS, load_urdf

    chosen = dict(word.split("=", 1) for word in links or () if "=" in word)
    if len(chosen) < len(links or ()) or not chosen.keys() <= SENSORS.keys():
        raise InputError(f"--link: expected DEVICE=LINK once for each device, which is one of {', '.join(SENSORS)}")
    robot = load_urdf(file, chosen)
    for text in robot.remarks:
        remark(text)
    text = yaml_text(robot.sections())
    if output is None:
        typer.echo(text, nl=False)
    else:
        with output.open("x", encoding="utf-8") as stream:
            stream.write(text)


def described(config: "TruckConfig") -> "Description":
    """Build the robot with the frames of its sensors.

    Raises:
        InputError: its body cannot be described.
    """
    from monstertruck_kinematics.description import SensorFrame
    from monstertruck_sim.world.mechanics import description as describe
    from monstertruckd.assembly.estimation import sensor_mounts

    truck, parts = _parts(config)
    sensors = tuple(
        SensorFrame(name, (m.x, m.y, m.z), (m.roll, m.pitch, m.yaw)) for name, m in sensor_mounts(config).items()
    )
    return describe(truck, parts, sensors)


def model_text(config: "TruckConfig") -> str:
    """Format the robot on level ground as MJCF."""
    from monstertruck_sim.world3d.engine import drive_line
    from monstertruck_sim.world3d.model import EMPTY, mjcf

    truck, parts = _parts(config)
    return mjcf(described(config), drive_line(truck, parts), parts.friction, EMPTY) + "\n"


def _parts(config: "TruckConfig") -> "tuple[SimTruckConfig, Mechanics]":
    """Body and dimensions as configured for the daemon; masses and springs as simulated."""
    from monstertruck_sim.world.config import SOLID_BODIES, WorldConfig
    from monstertruck_sim.world.mechanics import mechanics
    from monstertruckd.tools.simulation.config import SimulatedTruckConfig

    if config.body.kind not in SOLID_BODIES:
        raise InputError(f"body {config.body.kind}: cannot be described; expected one of {', '.join(SOLID_BODIES)}")
    world = config.sim.world if isinstance(config, SimulatedTruckConfig) else WorldConfig()
    geometry = config.geometry
    mass = world.truck.mass if isinstance(config, SimulatedTruckConfig) else geometry.mass
    truck = world.truck.model_copy(
        update={
            "body": config.body,
            "wheelbase": geometry.wheelbase,
            "track": geometry.track,
            "wheel_radius": geometry.wheel_radius,
            "length": geometry.length,
            "width": geometry.width,
            "mass": mass,
        }
    )
    return truck, mechanics(truck, world.mechanics)
