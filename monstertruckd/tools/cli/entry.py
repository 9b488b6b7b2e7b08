"""The command line's start: a command loads its own module only, and the list of commands loads none."""

import json
import os
import sys
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from typing import Any, Final

import typer

from monstertruckd import __version__
from monstertruckd.tools.cli.output import HELP_SETTINGS, HELP_STYLE, CommandGroup, Commands

SUMMARIES: Final = Path(__file__).with_name("summaries.json")
"""First paragraph of each command's help, by name; None if it is hidden. `python -m tests.make_summaries` writes it."""


@dataclass(frozen=True, slots=True)
class Row:
    """A command and its module in this package."""

    module: str
    name: str
    """Name of its function there; of a group, ``app``."""
    command_class: str | None = None
    """Name of its class there; None for ``NumberCommand``."""
    settings: Mapping[str, Any] = field(default_factory=dict)
    """Further settings of ``typer.Typer.command``."""

    def mount(self, app: typer.Typer, name: str) -> None:
        """Import it, and add it to ``app``."""
        module = import_module(f"monstertruckd.tools.cli.{self.module}")
        found = getattr(module, self.name)
        if isinstance(found, typer.Typer):
            app.add_typer(found, name=name)
            return
        chosen = {} if self.command_class is None else {"cls": getattr(module, self.command_class)}
        app.command(name, **chosen, **self.settings)(found)


MINUS: Final = {"context_settings": {"ignore_unknown_options": True}}
"""For arguments such as the pose -1,2,0."""

COMMANDS: Final[Mapping[str, Row]] = {
    "demo": Row("demo", "demo"),
    "try": Row("demo", "try_out"),
    "simulate": Row("demo", "simulate"),
    "drill": Row("drill", "drill"),
    "run": Row("robot", "run"),
    "new-driver": Row("new", "new_driver"),
    "new-robot": Row("new", "new_robot", "AnswersCommand"),
    "check-config": Row("config", "show", settings={"hidden": True}),  # its name before there were others
    "description": Row("description", "description"),
    "topics": Row("robot", "topics"),
    "reasons": Row("robot", "reasons"),
    "plugins": Row("robot", "plugins"),
    "status": Row("live", "status"),
    "echo": Row("live", "echo"),
    "drive": Row("orders", "drive"),
    "arm": Row("orders", "arm"),
    "disarm": Row("orders", "disarm"),
    "estop": Row("orders", "estop"),
    "reset": Row("orders", "reset"),
    "plan": Row("plan", "plan", settings=MINUS),
    "goto": Row("goto", "goto", settings=MINUS),
    "track": Row("goto", "track"),
    "path": Row("goto", "path"),
    "convert-path": Row("goto", "convert_path"),
    "convert-lens": Row("config", "convert_lens"),
    "import-urdf": Row("description", "import_urdf"),
    "move": Row("move", "move", "MoveCommand"),
    "get": Row("settings", "get"),
    "set": Row("settings", "set_value", settings=MINUS),
    "explore": Row("goto", "explore", "ExploreCommand"),
    "plan-server": Row("robot", "plan_server"),
    "replay": Row("replay", "replay"),
    "emulate": Row("devices", "emulate"),
    "probe": Row("devices", "probe"),
    "usb": Row("usb", "usb"),
    "find-port": Row("usb", "find_port"),
    "station": Row("station", "station"),
    "ros2": Row("ros2", "ros2"),
    "doctor": Row("doctor", "doctor"),
    "install-service": Row("service", "install_service"),
    "uninstall-service": Row("service", "uninstall_service"),
    "dock": Row("goto", "dock", "DockCommand"),
    "undock": Row("goto", "undock", "DockCommand"),
    "behave": Row("behave", "app"),
    "mission": Row("mission", "app"),
    "config": Row("config", "app"),
    "calibrate": Row("calibrate", "app"),
    "log": Row("logs", "app"),
    "kinematics": Row("kinematics", "app"),
    "study": Row("study", "app"),
    "tune": Row("tune", "app"),
    "stand": Row("stand", "app"),
    "map": Row("maps", "app"),
    "points": Row("points", "app"),
    "zone": Row("zones", "app"),
    "security": Row("security", "app"),
}
"""Commands and groups, in the order of the help."""


def mounted(names: Iterable[str]) -> typer.Typer:
    """Return the command line with these commands only."""
    app = _empty()
    for name in names:
        COMMANDS[name].mount(app, name)
    return app


def listed() -> typer.Typer:
    """Return the command line with every command's summary, which is enough for its own help."""
    app = _empty()
    for name, summary in json.loads(SUMMARIES.read_text(encoding="utf-8")).items():
        app.command(name, help=summary, hidden=summary is None)(_nothing)
    return app


def main() -> None:
    """Run the command line."""
    arguments = sys.argv[1:]
    if any(name.endswith("_COMPLETE") for name in os.environ):  # a shell asks: its words are in the environment
        app = mounted(COMMANDS)
    elif arguments[:1] in ([], ["-h"], ["--help"]):
        app = listed()
    else:
        app = mounted(arguments[:1] if arguments[0] in COMMANDS else COMMANDS)
    app()


def _empty() -> typer.Typer:
    app = Commands(
        name="monstertruckd",
        cls=CommandGroup,
        help="A daemon that controls all devices of a four-wheel-steered robot truck, drives it and records its data.",
        no_args_is_help=True,
        pretty_exceptions_enable=False,
        rich_markup_mode=HELP_STYLE,
        context_settings=HELP_SETTINGS,
    )
    app.callback()(_options)
    return app


def _version(wanted: bool) -> None:
    if wanted:
        typer.echo(__version__)
        raise typer.Exit


def _options(
    version: bool = typer.Option(False, "--version", callback=_version, is_eager=True, help="Print the version."),
) -> None:
    pass


def _nothing() -> None:
    """Stand for a command that is listed only."""
