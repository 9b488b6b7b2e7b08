"""Options and arguments from the fields of a settings model, which is loaded when the command is used."""

import inspect
import re
from abc import abstractmethod
from collections.abc import Callable, Iterator
from enum import StrEnum
from types import UnionType
from typing import TYPE_CHECKING, Annotated, Any, Final, Literal, Union, get_args, get_origin

import typer

from monstertruck_runtime.errors import InputError
from monstertruckd.tools.cli.options import parse_angle
from monstertruckd.tools.cli.output import NumberCommand, in_own_words

if TYPE_CHECKING:
    from pydantic import BaseModel
    from typer._click import Context
    from typer._click.core import Parameter

DURATIONS: Final = {"": 1.0, "s": 1.0, "min": 60.0, "h": 3600.0}


def seconds_of(text: str) -> float:
    """Seconds of a duration such as 90, 90s, 20min or 1.5h.

    Raises:
        InputError: it is none.
    """
    found = re.fullmatch(r"\s*(\d+(?:\.\d*)?|\.\d+)\s*(s|min|h|)\s*", text)
    seconds = 0.0 if found is None else float(found[1]) * DURATIONS[found[2]]
    if seconds <= 0.0:
        raise InputError(f"duration {text!r}: expected a number above 0 with s, min or h, such as 20min")
    return seconds


PARSERS: Final[dict[str, tuple[Callable[[str], float], str, str]]] = {
    "rad": (parse_angle, "DEGREES", "degrees"),
    "s": (seconds_of, "TIME", "s, or such as 20min"),
}
"""How people enter a value of a unit, what the help calls it, and the unit that they enter."""


class ModelCommand(NumberCommand):
    """Command with further options, most of them of a model; those that were given are in the context's ``obj``."""

    _params: "list[Parameter]"
    _added: "list[Parameter] | None" = None

    @abstractmethod
    def added(self) -> Iterator[inspect.Parameter]:
        """Yield the further options, as keyword parameters of a function; None stands for one that is not given."""

    @property
    def params(self) -> "list[Parameter]":
        """Declared options, and from the first use on the further ones."""
        if self._added is None:
            every = typer.Typer(add_completion=False)
            every.command()(_with_parameters(list(self.added())))
            self._added = [one for one in typer.main.get_command(every).params if one.name != "help"]
            self._params += self._added
        return self._params

    @params.setter
    def params(self, declared: "list[Parameter]") -> None:
        self._params = declared

    def invoke(self, ctx: "Context") -> Any:
        """Run it.

        Raises:
            InputError: a model rejects a value.
        """
        from pydantic import ValidationError

        from monstertruck_schemas.base import first_mistake

        names = [parameter.name or "" for parameter in self._added or ()]
        ctx.obj = {name: given for name in names if (given := ctx.params.pop(name)) is not None}
        try:
            return super().invoke(ctx)
        except ValidationError as error:
            key, _, text = first_mistake(error).rpartition(": ")
            options = {one.name: one.opts[0] for one in self._added or ()}
            where = options.get(key, key)
            raise InputError((f"{where}: " if where else "") + in_own_words(f": {text}").removeprefix(": ")) from error


def _with_parameters(parameters: list[inspect.Parameter]) -> Callable[..., None]:
    def command(**options: Any) -> None:
        pass

    command.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    command.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
    return command


def parameter(name: str, kind: Any, declared: Any) -> inspect.Parameter:
    """Return an option or argument of a type for ``ModelCommand``."""
    keyword = inspect.Parameter.KEYWORD_ONLY
    return inspect.Parameter(name, keyword, default=None, annotation=Annotated[kind | None, declared])


def field_parameters(
    model: "type[BaseModel]",
    *names: str,
    arguments: bool = False,
    defaults: bool = False,
    switches: dict[str, str] | None = None,
) -> Iterator[inspect.Parameter]:
    """Yield an option for each field: its help is the field's docstring, its values are entered as people write them.

    Angles are entered in degrees, durations with a unit. The model judges the values.

    Args:
        model: model of the settings.
        names: fields.
        arguments: make arguments instead of options.
        defaults: state the model's defaults in the help; otherwise the robot's configuration may set others.
        switches: words of a truth value other than ``--name/--no-name``, by field.
    """
    from monstertruck_schemas.base import field_docs

    docs = field_docs(model)
    for name in names:
        text = re.sub(r"\b(null|None)\b", "left out", " ".join(docs[name].split()))
        unit = re.search(r"(?<=, |.\()(rad|s)\b(?![/^])", text)
        kind, settings = _kind(name, model.model_fields[name].annotation)
        if unit is not None and kind is float:
            settings["parser"], settings["metavar"], entered = PARSERS[unit[1]]
            text = text[: unit.start()] + entered + text[unit.end() :]
        if defaults:
            text += f"; default: {model.model_fields[name].default}"
        settings |= {"help": text, "show_default": False}
        if arguments:
            yield parameter(name, kind, typer.Argument(**settings))
        else:
            words = (switches or {}).get(name, f"--{name.replace('_', '-')}")
            yield parameter(name, kind, typer.Option(words, **settings))


def _kind(name: str, annotation: Any) -> tuple[Any, dict[str, Any]]:
    """Return a field's option type, ignoring None, and its integer bounds."""
    if get_origin(annotation) is Annotated:
        kind, settings = _kind(name, get_args(annotation)[0])
        bounds = get_args(annotation)[1].metadata if kind is int else ()
        names = (("min", "ge"), ("max", "le"))
        found = {name: getattr(bound, key) for bound in bounds for name, key in names if hasattr(bound, key)}
        return kind, settings | found
    if get_origin(annotation) in (Union, UnionType):
        return _kind(name, next(one for one in get_args(annotation) if one is not type(None)))
    if get_origin(annotation) is Literal:
        return StrEnum(name, {word.upper(): word for word in get_args(annotation)}), {}
    return annotation, {}
