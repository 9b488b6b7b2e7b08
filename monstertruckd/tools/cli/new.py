"""``new-robot``: a robot's configuration and its simulated twin, from answers; ``new-driver``: a driver's package."""

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from monstertruck_runtime.errors import InputError
from monstertruckd.tools.cli.output import NumberCommand, on_terminal, remark
from monstertruckd.tools.new_driver.write import DriverKind, write_driver

if TYPE_CHECKING:
    import inspect

    from typer._click import Context
    from typer._click.core import Parameter


class AnswersCommand(NumberCommand):
    """Command with an option for every answer; the model behind them is loaded when the command is used."""

    _params: "list[Parameter]"
    _answers: "list[Parameter] | None" = None

    @property
    def params(self) -> "list[Parameter]":
        """Declared options, and from the first use on those of the answers."""
        if self._answers is None:
            every = typer.Typer(add_completion=False)
            every.command()(_with_options())
            self._answers = [one for one in typer.main.get_command(every).params if one.name != "help"]
            self._params += self._answers
        return self._params

    @params.setter
    def params(self, declared: "list[Parameter]") -> None:
        self._params = declared

    def invoke(self, ctx: "Context") -> Any:
        """Run it; the answers are in the context's ``obj``."""
        names = [parameter.name or "" for parameter in self._answers or ()]
        ctx.obj = {name: given for name in names if (given := ctx.params.pop(name)) is not None}
        return super().invoke(ctx)


def new_robot(
    context: typer.Context,
    name: Annotated[str, typer.Argument(help="Name of the robot and of its folder.", show_default=False)],
    folder: Annotated[Path, typer.Option("--folder", help="Where its folder is made.")] = Path(),
    ask: Annotated[bool, typer.Option("--ask/--no-ask", help="Ask on a terminal for what no option says.")] = True,
) -> None:
    """Write a new robot's configuration and its simulated twin, and print the commands to enter next.

    The new folder holds robot.yaml, simulation.yaml and twin.yaml. Existing files are never overwritten.
    """
    from pydantic import ValidationError

    from monstertruck_drivers.computer import Sysfs
    from monstertruck_drivers.usb.tree import read_tree
    from monstertruck_schemas.base import first_mistake
    from monstertruckd.tools.new_robot.answers import Answers, check_complete
    from monstertruckd.tools.new_robot.write import next_commands, write_robot

    given = {"name": name} | context.obj
    if ask and on_terminal(sys.stdin):
        given = _asked(given)
    check_complete(given)
    try:
        answers = Answers.model_validate(given, strict=False)
    except ValidationError as error:
        raise InputError(first_mistake(error)) from error
    made = write_robot(answers, folder, read_tree(Sysfs()))
    remark(f"written: {made}; next:")
    print("\n".join(next_commands(made)))


def _asked(given: dict[str, Any]) -> dict[str, Any]:
    """The answers, with those that a person gives to the questions that are left."""
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


def _with_options() -> Any:
    """A function whose parameters are the options of all answers."""
    import inspect

    from monstertruckd.tools.new_robot.answers import Answers, question

    def option(name: str) -> "inspect.Parameter":
        field = Answers.model_fields[name]
        usual = "" if field.is_required() or field.default is None else f"; default: {field.default}"
        text = question(name) + usual
        declared = typer.Option(f"--{name.replace('_', '-')}", help=text, show_default=False)
        kind = inspect.Parameter.KEYWORD_ONLY
        return inspect.Parameter(name, kind, default=None, annotation=Annotated[str | None, declared])

    def answers(**options: Any) -> None:
        pass

    parameters = [option(name) for name in Answers.model_fields if name != "name"]
    answers.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    answers.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
    return answers


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
        "export PYTHONPATH=$PWD/plugins\nmonstertruckd plugins\n"
        f"monstertruckd emulate {name} --link /tmp/{name}\n"
        f"monstertruckd probe {name} --port /tmp/{name}  # in a second terminal, with the same PYTHONPATH"
    )
