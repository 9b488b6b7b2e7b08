"""Commands of the robot itself: run the daemon, check its configuration, print its topic table."""

import json
from pathlib import Path
from typing import Annotated, Any

import typer

from monstertruckd.cli.options import ConfigOption
from monstertruckd.cli.output import JsonOption, print_json, print_table


def run(config: ConfigOption, verbose: Annotated[bool, typer.Option("--verbose", "-v")] = False) -> None:
    """Run the daemon until SIGTERM or Ctrl-C: neutral first, then everything is closed in order."""
    from monstertruckd.run import run_daemon

    raise typer.Exit(run_daemon(config, verbose=verbose).exit_code)


def check_config(
    config: Annotated[Path, typer.Argument(help="Configuration to check.")],
    json_output: JsonOption = False,
) -> None:
    """Print the resolved configuration with the origin of every value; exit code 2 if it is refused."""
    from monstertruckd.config.load import load_truck
    from monstertruckd.config.validate import resolved

    loaded, tree = load_truck(config)
    values = resolved(loaded)
    if json_output:
        origins = {".".join(map(str, key)): str(origin) for key, origin in tree.origins.items() if key}
        typer.echo(json.dumps({"config": values, "origins": origins}, indent=2))
        return
    for key, value in _leaves(values, ()):
        origin = tree.origins.get(key)
        typer.echo(f"{'.'.join(map(str, key)):48} {_short(value):40} {origin or 'default'}")


def _leaves(value: Any, key: tuple[str | int, ...]) -> list[tuple[tuple[str | int, ...], Any]]:
    if isinstance(value, dict) and value:
        return [leaf for name, inner in value.items() for leaf in _leaves(inner, (*key, name))]
    return [(key, value)]


def _short(value: Any) -> str:
    return "-" if value is None else json.dumps(value)


def topics(json_output: JsonOption = False) -> None:
    """Print the topic table: every key, its message, rate, writer and who keeps it."""
    from monstertruck_schemas.topics import TOPICS

    if json_output:
        rows = [
            {
                "name": topic.name,
                "key": topic.key("<robot>"),
                "schema": topic.schema_name,
                "rate_hz": topic.rate,
                "stale_after_s": topic.stale_after,
                "writer": topic.writer.value,
                "logged": topic.logged,
                "retained": topic.retained,
                "doc": topic.doc,
            }
            for topic in TOPICS
        ]
        print_json(rows)
        return
    print_table(
        ("name", "schema", "Hz", "stale s", "writer", "kept", "what"),
        [
            (
                topic.name,
                topic.schema_name,
                "" if topic.rate is None else f"{topic.rate:g}",
                "" if topic.stale_after is None else f"{topic.stale_after:g}",
                topic.writer.value,
                " ".join(word for word, is_so in (("logged", topic.logged), ("retained", topic.retained)) if is_so),
                topic.doc,
            )
            for topic in TOPICS
        ],
        right=("Hz", "stale s"),
        title="Topics: mt/<robot>/<name>",
    )
