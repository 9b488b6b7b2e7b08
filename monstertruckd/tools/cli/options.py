"""Options and arguments common to many commands, with their shell completion."""

import inspect
import math
from collections.abc import Callable, Collection, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Annotated, Any, Final

import typer

from monstertruck_runtime.endpoints import DEFAULT_ENDPOINT, is_endpoint, nearest
from monstertruck_runtime.errors import InputError
from monstertruckd.tools.cli.output import WHICH_ROBOT
from monstertruckd.tools.cli.places import only_robot
from monstertruckd.tools.shipped import configuration, names

ALWAYS: Final = "estop"
"""Command that is not refused when several robots answer: it uses the default port at once."""


def complete_topic(incomplete: str) -> Iterator[tuple[str, str]]:
    """Complete topics, with their content."""
    from monstertruck_schemas.topics import TOPICS

    return ((topic.name, topic.doc) for topic in TOPICS if topic.name.startswith(incomplete))


def complete_device(incomplete: str) -> Iterator[tuple[str, str]]:
    """Complete roles and kinds of devices."""
    from monstertruck_drivers.catalog import DEVICES

    words = [(role, DEVICES.named(role).name) for role in DEVICES.roles]
    words += [(kind.name, kind.role.name) for kind in DEVICES.values()]
    return (word for word in words if word[0].startswith(incomplete))


def complete_planner(incomplete: str) -> Iterator[tuple[str, str]]:
    """Complete kinds of route planners."""
    from monstertruck_planners.route.catalog import ROUTE_PLANNERS

    return ((name, row.doc) for name, row in ROUTE_PLANNERS.items() if name.startswith(incomplete))


def complete_role(incomplete: str) -> list[str]:
    """Complete roles of devices in a configuration."""
    from monstertruck_drivers.config import Devices

    return [role for role in Devices.model_fields if role.startswith(incomplete)]


def complete_config(incomplete: str) -> list[str]:
    """Complete bundled configurations, and files of the folder ``configs``; the shell completes other file names."""
    files = (*Path("configs").glob("*.yaml"), *Path("configs", "robots").glob("*.yaml"))
    return [word for word in (*names(), *sorted(map(str, files))) if word.startswith(incomplete)]


def bundled(given: Path | None) -> Path | None:
    """Resolve the file of a configuration option or argument; see ``configuration``."""
    return None if given is None else configuration(given)


def _noted(context: typer.Context, option: typer.CallbackParam, value: str) -> str:
    """Make the command suggested by a refusal address the same robot."""
    if value not in ("truck", DEFAULT_ENDPOINT):  # options that ``arm`` and ``reset`` accept
        context.meta.setdefault(WHICH_ROBOT, {})[option.name] = f"{option.opts[0]} {value}"
    return value


def _nearest(context: typer.Context, option: typer.CallbackParam, value: str) -> str:
    if not _typed(context, option.name) and context.info_name != ALWAYS:
        return only_robot(context.params.get("robot") if _typed(context, "robot") else None)
    endpoint = _noted(context, option, value)
    if not is_endpoint(endpoint):
        raise InputError(
            f"--endpoint {endpoint!r}: expected tcp/HOST:PORT or tls/HOST:PORT, such as {DEFAULT_ENDPOINT}"
        )
    return nearest(endpoint)


def _typed(context: typer.Context, name: str | None) -> bool:
    source = context.get_parameter_source(name or "")
    return source is not None and source.name != "DEFAULT"


RobotOption = Annotated[str, typer.Option("--robot", "-r", help="Name of the robot.", callback=_noted)]
EndpointOption = Annotated[
    str,
    typer.Option(
        "--endpoint",
        "-e",
        help="Address of the robot: tcp/HOST:PORT or tls/HOST:PORT. A daemon on this machine is reached by "
        "its Unix socket and reserves places apart from those of stations.",
        callback=_nearest,
    ),
]
ConfigOption = Annotated[
    Path,
    typer.Option(
        "--config",
        "-c",
        help="Configuration of this robot or experiment: a file (YAML), or the name of a bundled one, such as goals.",
        show_default=False,
        autocompletion=complete_config,
        callback=bundled,
    ),
]
SimulatedOption = Annotated[
    Path,
    typer.Option(
        "--config",
        "-c",
        help="Configuration of a simulated robot: a file, or the name of a bundled one, such as goals or mecanum.",
        autocompletion=complete_config,
        callback=bundled,
    ),
]
ConfigArgument = Annotated[
    Path,
    typer.Argument(
        help="Configuration: a file (YAML), or the name of a bundled one, such as demo.",
        show_default=False,
        autocompletion=complete_config,
        callback=bundled,
    ),
]
TopicArgument = Annotated[
    str,
    typer.Argument(
        help="Name from `monstertruckd topics`, e.g. state/pose.", show_default=False, autocompletion=complete_topic
    ),
]


UNITS: Final = {"deg": math.pi / 180, "°": math.pi / 180, "rad": 1.0}
"""Factors from the units of an angle to rad."""


def parse_angle(text: str) -> float:
    """Parse an angle in degrees (``90``, ``90deg``, ``90°``) or radians (``1.57rad``), in rad; accepts nan and inf.

    Raises:
        BadParameter: it is not a number with one of these units, or without a unit.
    """
    unit = next((unit for unit in UNITS if text.endswith(unit)), "")
    try:
        return float(text.removesuffix(unit)) * UNITS[unit or "deg"]
    except ValueError:
        raise typer.BadParameter("expected degrees, or radians such as 1.57rad") from None


def parse_heading(text: str) -> float:
    """Parse a heading, in rad.

    Raises:
        BadParameter: it is not an angle.
        InputError: it exceeds one turn, as radians converted twice would.
    """
    heading = parse_angle(text)
    if math.tau < abs(heading) < math.inf:
        raise InputError(f"heading {text}: expected at most one turn, 360 degrees or 6.283rad")
    return heading


HEADING: Final = "Heading in the map, degrees, counter-clockwise from x; or 1.57rad."


def parse_pose(text: str, *, yaw_needed: bool = True) -> tuple[float, ...]:
    """Parse the numbers of a pose, m and rad; nan and inf are accepted, so that the planner refuses them by name.

    Raises:
        InputError: values that are not numbers, too few of them, or a heading above one turn.
    """
    expected = "x,y,yaw" if yaw_needed else "x,y or x,y,yaw"
    words = text.split(",")
    values: tuple[float, ...] = ()
    if len(words) == 3 or (len(words) == 2 and not yaw_needed):
        with suppress(ValueError, typer.BadParameter):
            values = (*map(float, words[:2]), *map(parse_heading, words[2:]))
    if not values:
        raise InputError(f"pose {text!r}: expected {expected}, m and degrees")
    return values


def require_finite(*poses: tuple[float, ...]) -> None:
    """Refuse invalid poses before contacting a robot.

    Raises:
        InputError: a pose contains nan or an infinite number.
    """
    for pose in poses:
        if not all(map(math.isfinite, pose)):
            shown = ",".join(f"{value:g}" for value in (*pose[:2], *map(math.degrees, pose[2:])))
            raise InputError(f"pose {shown}: expected finite numbers, m and degrees")


ViaOption = Annotated[
    list[str] | None,
    typer.Option(metavar="X,Y[,YAW]", help="Pose or position to pass on the route, m and degrees; may be repeated."),
]


def with_parameters(
    command: Callable[..., None], *functions: Callable[..., Any], without: Collection[str] = ()
) -> Callable[..., None]:
    """Give ``command``, which accepts any keywords, the parameters of ``functions`` as its options.

    Excludes parameters that collect keywords, and those in ``without``. The help comes from the first function.
    """
    every = (parameter for function in functions for parameter in inspect.signature(function).parameters.values())
    parameters = [
        parameter.replace(kind=parameter.KEYWORD_ONLY)
        for parameter in every
        if parameter.kind is not parameter.VAR_KEYWORD and parameter.name not in without
    ]
    command.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    command.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
    command.__doc__ = functions[0].__doc__
    return command
