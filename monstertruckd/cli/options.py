"""Options and arguments that many commands share, with what a shell completes for them."""

from collections.abc import Iterator
from pathlib import Path
from typing import Annotated

import typer

ENDPOINT = "tcp/127.0.0.1:7447"


def complete_topic(incomplete: str) -> Iterator[tuple[str, str]]:
    """Topics with what they carry."""
    from monstertruck_schemas.topics import TOPICS

    return ((topic.name, topic.doc) for topic in TOPICS if topic.name.startswith(incomplete))


def complete_device(incomplete: str) -> Iterator[tuple[str, str]]:
    """Roles and kinds of devices."""
    from monstertruckd.catalog import BY_ROLE

    words = [(role, kind.name) for role, kind in BY_ROLE.items()]
    words += [(kind.name, role) for role, kind in BY_ROLE.items()]
    return (word for word in words if word[0].startswith(incomplete))


def complete_role(incomplete: str) -> list[str]:
    """Places for devices in a configuration."""
    from monstertruckd.config.truck import Devices

    return [role for role in Devices.model_fields if role.startswith(incomplete)]


def complete_config(incomplete: str) -> list[str]:
    """Configurations of the folder ``configs``; for anything else the shell completes file names itself."""
    files = (*Path("configs").glob("*.yaml"), *Path("configs", "robots").glob("*.yaml"))
    return sorted(str(file) for file in files if str(file).startswith(incomplete))


RobotOption = Annotated[str, typer.Option("--robot", "-r", help="Name of the robot.")]
EndpointOption = Annotated[str, typer.Option("--endpoint", "-e", help="Where the robot listens.")]
ConfigOption = Annotated[
    Path,
    typer.Option(
        "--config",
        "-c",
        help="Configuration of this robot or experiment (YAML).",
        show_default=False,
        autocompletion=complete_config,
    ),
]
SimulatedOption = Annotated[
    Path,
    typer.Option("--config", "-c", help="Configuration of a simulated truck.", autocompletion=complete_config),
]
ConfigArgument = Annotated[
    Path, typer.Argument(help="Configuration (YAML).", show_default=False, autocompletion=complete_config)
]
TopicArgument = Annotated[
    str,
    typer.Argument(
        help="Name from `monstertruckd topics`, e.g. state/pose.", show_default=False, autocompletion=complete_topic
    ),
]
