"""Commands on configuration files: check, show, upgrade, and convert camera intrinsics."""

import difflib
import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from monstertruck_runtime.errors import InputError
from monstertruckd.tools.calibrate.lens_forms import LensForm
from monstertruckd.tools.cli.options import ConfigArgument
from monstertruckd.tools.cli.output import JsonOption, command_group, print_json, print_table, remark

if TYPE_CHECKING:
    from monstertruckd.config.migrate import Upgrade

app = command_group("Check, show and upgrade configuration files.")

Key = tuple[str | int, ...]


@app.command("show")
def show(
    config: ConfigArgument,
    keys: Annotated[
        list[str] | None,
        typer.Option("--key", "-k", help="Only settings at or below this key, e.g. gate.leases; repeatable."),
    ] = None,
    json_output: JsonOption = False,
) -> None:
    """Check a configuration and print every value with its origin: file and line, calibration, or default.

    Exit code 2 if it is invalid, with one line for each error.
    """
    from monstertruck_runtime.errors import NotFoundError
    from monstertruckd.config.load import resolved
    from monstertruckd.tools.simulation.config import load_robot

    loaded, tree = load_robot(config)
    values = resolved(loaded)
    leaves = [(key, value) for key, value in _leaves(values, ()) if _wanted(key, keys)]
    if not leaves:
        raise NotFoundError(f"{config}: no settings at {', '.join(keys or ())}; sections: {', '.join(values)}")
    if json_output:
        origins = {_dotted(key): str(origin) for key, origin in tree.origins.items() if key and _wanted(key, keys)}
        print_json({"config": _kept(values, (), {key for key, _ in leaves}), "origins": origins})
        return
    rows = [(_dotted(key), _short(value), str(tree.origins.get(key) or "default")) for key, value in leaves]
    print_table(("key", "value", "origin"), rows)


def _dotted(key: Key) -> str:
    return ".".join(map(str, key))


def _wanted(key: Key, filters: list[str] | None) -> bool:
    return not filters or any(f"{_dotted(key)}.".startswith(f"{wanted}.") for wanted in filters)


def _leaves(value: Any, key: Key) -> list[tuple[Key, Any]]:
    if isinstance(value, dict) and value:
        return [leaf for name, inner in value.items() for leaf in _leaves(inner, (*key, name))]
    return [(key, value)]


def _kept(value: Any, key: Key, leaves: set[Key]) -> Any:
    """Return ``value`` reduced to the given leaves."""
    if key in leaves or not isinstance(value, dict):
        return value
    inside = {name: (*key, name) for name in value}
    return {
        name: _kept(value[name], inner, leaves)
        for name, inner in inside.items()
        if any(leaf[: len(inner)] == inner for leaf in leaves)
    }


def _short(value: Any) -> str:
    return "-" if value is None else json.dumps(value)


@app.command("migrate")
def migrate(
    config: ConfigArgument,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Show the changes without writing them.")] = False,
    json_output: JsonOption = False,
) -> None:
    """Upgrade a configuration of an older version, including all included files.

    Comments are kept; the previous file is kept next to the new one as NAME.vN.
    """
    from monstertruckd.config.load import FILE_VERSION
    from monstertruckd.config.migrate import carry_out, plan

    upgrades = plan(config)
    if not dry_run:
        carry_out(upgrades)
    if json_output:
        print_json({"version": FILE_VERSION, "files": [_as_json(upgrade, written=not dry_run) for upgrade in upgrades]})
        return
    for upgrade in upgrades:
        if dry_run:
            print(_difference(upgrade), end="")
        else:
            print(f"{upgrade.path}: version {upgrade.version} to {FILE_VERSION}; the previous file is {upgrade.kept}")
    if not upgrades:
        remark(f"{config}: up to date, version {FILE_VERSION}")


def _as_json(upgrade: "Upgrade", *, written: bool) -> dict[str, Any]:
    facts = {"path": upgrade.path, "version": upgrade.version, "changes": _difference(upgrade)}
    return {**facts, "previous": upgrade.kept if written else None}


def _difference(upgrade: "Upgrade") -> str:
    before, after = upgrade.before.splitlines(keepends=True), upgrade.after.splitlines(keepends=True)
    return "".join(difflib.unified_diff(before, after, str(Path(upgrade.path)), str(upgrade.path)))


def convert_lens(
    file: Annotated[
        Path,
        typer.Argument(
            help="Camera intrinsics of ROS, kalibr or OpenCV (YAML), or a robot's configuration.", show_default=False
        ),
    ],
    output: Annotated[Path | None, typer.Argument(help="File to write; default: standard output.")] = None,
    form: Annotated[LensForm, typer.Option("--format", "-f", help="Output format.")] = LensForm.CONFIG,
    camera: Annotated[
        str | None, typer.Option(help="Camera name in a chain of cameras, e.g. cam0.", show_default=False)
    ] = None,
    size: Annotated[
        str | None,
        typer.Option(help="Image size in pixels, e.g. 640x480, if the file does not state it.", show_default=False),
    ] = None,
) -> None:
    """Convert camera intrinsics to another format; `config` is the section `devices.camera.driver.lens`."""
    from monstertruck_runtime.outside import text_of
    from monstertruck_runtime.small_files import replace_file
    from monstertruck_runtime.yaml_files import LARGEST_YAML
    from monstertruck_schemas.body import LensConfig
    from monstertruckd.tools.calibrate.lens_files import EXPECTED, lens_from, lens_text
    from monstertruckd.tools.simulation.config import load_robot

    text = text_of(file, EXPECTED, LARGEST_YAML)
    if "\ndevices:" in f"\n{text}":
        device = load_robot(file)[0].devices.camera
        lens = None if device is None else getattr(device.driver, "lens", None)
        if not isinstance(lens, LensConfig):
            raise InputError(f"{file}: has no camera with lens parameters")
    else:
        lens = lens_from(text, file, camera=camera, size=_pixels(size))
    written = lens_text(lens, form)
    if output is None:
        typer.echo(written, nl=False)
    else:
        replace_file(output, written.encode())


def _pixels(size: str | None) -> tuple[int, int] | None:
    if size is None:
        return None
    width, _, height = size.partition("x")
    if not (width.isdecimal() and height.isdecimal()):
        raise InputError(f"--size {size}: expected WIDTHxHEIGHT, e.g. 640x480")
    return int(width), int(height)
