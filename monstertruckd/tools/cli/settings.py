"""``get`` and ``set``: settings that may be changed while the robot runs."""

import json
import math
from contextlib import suppress
from typing import Annotated, Any

import typer

from monstertruck_runtime.endpoints import DEFAULT_ENDPOINT
from monstertruck_runtime.errors import InputError, NotFoundError
from monstertruckd.tools.cli.connection import with_robot
from monstertruckd.tools.cli.options import EndpointOption, RobotOption
from monstertruckd.tools.cli.output import JsonOption, print_json, print_table, remark


def get(
    key: Annotated[str | None, typer.Argument(help="Only settings at or below this key, e.g. gate.tilt.")] = None,
    robot: RobotOption = "truck",
    endpoint: EndpointOption = DEFAULT_ENDPOINT,
    json_output: JsonOption = False,
) -> None:
    """List the settings that may be changed while the robot runs, with their values and bounds.

    Bounds by other settings or by the robot's body are reported when a value is refused.
    """
    rows = [
        row
        for row in with_robot(lambda client, _: client.call("settings"), robot, endpoint, named=False)["settings"]
        if _below(row["key"], key)
    ]
    if not rows:
        raise NotFoundError(
            f"{key}: not a setting that can be changed while the robot runs; `monstertruckd get` lists them"
        )
    if json_output:
        print_json(rows)
        return
    print_table(
        ("setting", "value", "at start", "bounds", "meaning"),
        [(row["key"], _text(row["value"]), _began(row), _bounds(row), _short(row["meaning"])) for row in rows],
        right=("value", "at start"),
    )


def set_value(
    key: Annotated[str, typer.Argument(help="Setting, e.g. gate.speed.")],
    value: Annotated[str, typer.Argument(help="New value, in the configuration's units.")],
    save: Annotated[bool, typer.Option("--save", help="Keep the value when the daemon restarts.")] = False,
    robot: RobotOption = "truck",
    endpoint: EndpointOption = DEFAULT_ENDPOINT,
    json_output: JsonOption = False,
) -> None:
    """Change a setting while the robot runs; it applies from the next control tick on.

    The whole configuration is checked as at the start: nothing passes the ceilings of the robot's body. Without --save
    it is forgotten when the daemon ends.
    """
    change = {"values": {key: _parsed(key, value)}, "save": save}
    answer = with_robot(lambda client, _: client.call("set", change), robot, endpoint)
    if json_output:
        print_json(answer)
    else:
        print(f"{key} is {value}" + (f", saved in {answer['file']}" if save else " until the daemon ends"))
    for text in answer["weakened"]:
        remark(f"less safe than the default: {text}")


def _below(key: str, wanted: str | None) -> bool:
    return wanted is None or f"{key}.".startswith(f"{wanted}.")


def _parsed(key: str, text: str) -> Any:
    """A number or truth value as such; anything else is text, which the model judges.

    Raises:
        InputError: a number that is not finite, which no setting may be.
    """
    with suppress(ValueError):
        if not math.isfinite(float(text)):
            raise InputError(f"{key} {text}: expected a finite number")
    try:
        value = json.loads(text)
    except ValueError:
        return text
    return value if isinstance(value, float | int | bool) else text


def _text(value: Any) -> str:
    return f"{value:g}" if isinstance(value, float) else str(value)


def _began(row: dict[str, Any]) -> str:
    return "" if row["began"] == row["value"] else _text(row["began"])


def _bounds(row: dict[str, Any]) -> str:
    names = (("above", "> "), ("at_least", ">= "), ("below", "< "), ("at_most", "<= "))
    return ", ".join(f"{sign}{_text(row[name])}" for name, sign in names if row[name] is not None)


def _short(meaning: str) -> str:
    """The first sentence."""
    return meaning.partition(". ")[0].partition(": ")[0].rstrip(".")
