"""``new-robot``: a robot's configuration and its simulated twin, from questions.

``new-driver``: the package of a driver.
"""

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from monstertruckd.tools.cli.model_options import ModelCommand, parameter
from monstertruckd.tools.cli.output import on_terminal, remark
from monstertruckd.tools.new_driver.write import DriverKind, write_driver

if TYPE_CHECKING:
    import inspect


class AnswersCommand(ModelCommand):
    """Command with an option for every answer."""

    def added(self) -> Iterator["inspect.Parameter"]:
        """Yield the answers as text, which they judge."""
        from monstertruckd.tools.new_robot.answers import Answers, question

        for name, field in Answers.model_fields.items():
            if name != "name":
                usual = "" if field.is_required() or field.default is None else f"; default: {field.default}"
                words = f"--{name.replace('_', '-')}"
                yield parameter(name, str, typer.Option(words, help=question(name) + usual, show_default=False))


def new_robot(
    context: typer.Context,
    name: Annotated[str, typer.Argument(help="Name of the robot and of its folder.", show_default=False)],
    folder: Annotated[Path, typer.Option("--folder", help="Parent folder of the new folder.")] = Path(),
    ask: Annotated[
        bool, typer.Option("--ask/--no-ask", help="Ask on the terminal for values that no option sets.")
    ] = True,
) -> None:
    """Write a new robot's configuration and its simulated twin, and print the commands to enter next.

    The new folder contains robot.yaml, simulation.yaml and twin.yaml. Existing files are never overwritten.
    """
    from monstertruck_drivers.computer import Sysfs
    from monstertruck_drivers.usb.tree import read_tree
    from monstertruckd.tools.new_robot.answers import Answers, check_complete
    from monstertruckd.tools.new_robot.write import next_commands, write_robot

    given = {"name": name} | context.obj
    if ask and on_terminal(sys.stdin):
        given = _asked(given)
    check_complete(given)
    answers = Answers.model_validate(given, strict=False)
    made = write_robot(answers, folder, read_tree(Sysfs()))
    remark(f"written: {made}; next:")
    print("\n".join(next_commands(made)))


def _asked(given: dict[str, Any]) -> dict[str, Any]:
    """Complete the answers by asking the user the remaining questions."""
    from monstertruckd.tools.new_robot.answers import Answers, asked, mistake, question

    for name, field in Answers.model_fields.items():
        if name in given or not asked(name, given):
            continue
        usual = None if field.is_required() else "" if field.default is None else str(field.default)
        while True:
            answer = typer.prompt(question(name), default=usual)
            if not answer and field.default is None:
                break
            if (wrong := mistake(name, answer)) is None:
                given = given | {name: answer}
                break
            remark(wrong)
    return given


def new_driver(
    kind: Annotated[
        DriverKind,
        typer.Argument(help="lidar: streams scans; sensor: answers polls; motors: drives shafts.", show_default=False),
    ],
    name: Annotated[str, typer.Argument(help="Name of the device kind, such as acme_l5.", show_default=False)],
    folder: Annotated[Path, typer.Option("--folder", help="Parent folder of the new folder.")] = Path(),
) -> None:
    """Write the package of a new driver: protocol, driver, emulator, identity and tests, which pass as written.

    Replace the protocol by that of the device, then adapt emulator and tests. Existing files are never overwritten.
    """
    made = write_driver(kind, name, folder)
    remark(f"written: {made}; next:")
    print(
        f"cd {made}\npython -m pytest\npython -m hatchling build -t wheel -d dist\n"
        f"python -m zipfile -e dist/{name}_driver-0.1-py3-none-any.whl plugins\n"
        "export PYTHONPATH=$PWD/plugins\nmonstertruckd plugins\n"
        f"monstertruckd emulate {name} --link /tmp/{name}\n"
        f"monstertruckd probe {name} --port /tmp/{name}  # in a second terminal, with the same PYTHONPATH"
    )
