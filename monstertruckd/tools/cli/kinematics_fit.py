"""The command `kinematics fit`: identify a skid-steer robot."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final

import typer

from monstertruckd.tools.cli.kinematics_output import figure, refusals
from monstertruckd.tools.cli.output import JsonOption, print_json, print_table

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from monstertruck_kinematics.identification import SkidModel

ABOUT: Final = """\
A skid-steer robot drove seven circles, published with their radii and speeds: columns are the ratio of its sides' wheel
rates and the faster one, rad/s. Each line is a model fitted to all of them, and how far it is off a circle:
  ideal             nominal wheel radius and track, no slip
  effective radius  one wheel radius for both sides
  symmetric         and one effective track
  centre of mass    and, instead of the track, an offset of the centre
  icr               and, instead, a turning centre for each side
  icr and slip      and a ratio of the sides' wheel radii
ls: least squares over radii and speeds; max: least worst error. A trajectory of one's own: kinematics fit FILE"""


def fit(
    trajectory: Annotated[
        Path | None, typer.Argument(help="CSV: time, left, right (rad/s), x, y (m), heading (rad). Default: paper.")
    ] = None,
    model: Annotated[str | None, typer.Option(help="Only this model.")] = None,
    radius: Annotated[float, typer.Option(help="Nominal wheel radius, m.")] = 0.021,
    half_track: Annotated[float, typer.Option(help="Half the left-right wheel distance, m.")] = 0.0525,
    window: Annotated[int, typer.Option(help="Samples over which motion is compared.")] = 10,
    bounded: Annotated[bool, typer.Option(help="Believable parameters only.")] = True,
    png: Annotated[Path | None, typer.Option("--png", help="Also draw a picture into this file.")] = None,
    json_output: JsonOption = False,
) -> None:
    """Identify a skid-steer robot: from a trajectory, or from the skid-steer paper's circles."""
    from monstertruck_kinematics.identification import MODEL_NAMES, skid_model

    with refusals():
        names: Sequence[Any] = [model] if model else MODEL_NAMES
        models = [skid_model(n, radius, half_track, bounded=bounded, with_icr_x=trajectory is not None) for n in names]
        if trajectory is not None:
            _fit_file(trajectory, models, window, json_output=json_output)
        else:
            _fit_paper(models, png, json_output=json_output)


def _fit_file(path: Path, models: "list[SkidModel]", window: int, *, json_output: bool) -> None:
    from monstertruck_kinematics.identification import fit_trajectory

    data = _read_trajectory(path)
    fits = [fit_trajectory(data[0], data[1:3], data[3:6], m, window=window) for m in models]
    if json_output:
        print_json(
            [
                {"model": f.model.name, "rms": f.fit.rms, "parameters": {n: [v, e] for n, v, e in f.parameter_table()}}
                for f in fits
            ]
        )
        return
    for f in fits:
        typer.echo(f"{f.model.name}: rms {f.fit.rms:.3f} of the expected noise")
        rows = [(n, f"{v:.5f}", f"{e:.5f}" if math.isfinite(e) else "open") for n, v, e in f.parameter_table()]
        print_table(("parameter", "value", "standard error"), rows, right=("value", "standard error"))


def _fit_paper(models: "list[SkidModel]", png: Path | None, *, json_output: bool) -> None:
    from monstertruck_kinematics.identification import (
        PUBLISHED_CIRCLES,
        PUBLISHED_HALF_TRACK,
        PUBLISHED_RADIUS,
        circle_errors,
        fit_circles,
        unexplained_spread,
    )
    from monstertruck_kinematics.skid_steer import SkidSteer

    ideal = SkidSteer.ideal(PUBLISHED_RADIUS, PUBLISHED_HALF_TRACK)
    errors = {"ideal": 100.0 * circle_errors(ideal, PUBLISHED_CIRCLES)}
    driven, radii = {}, {}
    for m in models:
        errors[f"{m.name}, ls"] = 100.0 * circle_errors(fit_circles(PUBLISHED_CIRCLES, m).robot, PUBLISHED_CIRCLES)
        highest = fit_circles(PUBLISHED_CIRCLES, m, objective="minimax")
        errors[f"{m.name}, max"] = 100.0 * circle_errors(highest.robot, PUBLISHED_CIRCLES)
        driven[m.name] = 100.0 * fit_circles(PUBLISHED_CIRCLES[:6], m, objective="minimax").fit.worst
        alone = fit_circles(PUBLISHED_CIRCLES, m, objective="minimax", radii_only=True)
        radii[m.name] = 100.0 * alone.fit.worst
    floor = 100.0 * unexplained_spread(PUBLISHED_CIRCLES)
    if json_output:
        print_json(
            {
                "circles": [c.label for c in PUBLISHED_CIRCLES],
                "radius_and_speed_errors_percent": {name: e.tolist() for name, e in errors.items()},
                "worst_percent_on_the_radii_alone": radii,
                "worst_percent_on_the_driven_ratios_alone": driven,
                "unexplained_percent": floor,
            }
        )
        return
    ratios = [c.label.removesuffix(" rad/s").replace("left ", "").replace(", ", "\n") for c in PUBLISHED_CIRCLES]
    print(ABOUT)
    for quantity, title in ((0, "radius error, %"), (1, "speed error, %")):
        heads = (title, *ratios, "worst")
        rows = [
            (name, *(f"{v:+.1f}" for v in e[quantity]), f"{abs(e[quantity]).max():.1f}") for name, e in errors.items()
        ]
        print()
        print_table(heads, rows, right=heads[1:])
    print()
    heads = ("worst error of fits of less, %", "all radii, no speeds", "2:1 and 3:1, both")
    print_table(heads, [(name, f"{radii[name]:.1f}", f"{driven[name]:.1f}") for name in driven], right=heads[1:])
    print(f"\nEqual ratios were measured up to {floor:.1f} % off one common speed per rate: no model explains that.")
    if png:
        _draw_errors(png, {name: abs(e).max(axis=0) for name, e in errors.items()})


def _read_trajectory(path: Path) -> "NDArray[Any]":
    """(6, N) columns of a CSV with or without a heading line."""
    import numpy as np

    from monstertruck_runtime.errors import InputError

    try:
        lines = path.read_text().splitlines()
    except OSError as error:
        raise InputError(f"{path}: {error.strerror}") from error
    rows = []
    for number, line in enumerate(lines, start=1):
        cells = line.split(",")
        try:
            rows.append([float(cell) for cell in cells])
        except ValueError as error:
            if number > 1:
                raise InputError(f"{path}:{number}: {error}") from error
            continue
        if len(cells) != 6:
            raise InputError(f"{path}:{number}: {len(cells)} columns: expected time, left, right, x, y, heading")
    return np.array(rows).reshape(-1, 6).T


def _draw_errors(path: Path, errors: "dict[str, NDArray[Any]]") -> None:
    with figure(path, "circle", "worst error of radius and speed, %") as axes:
        for name, row in errors.items():
            axes.plot(range(1, len(row) + 1), row, marker="o", label=name)
        axes.legend(fontsize="small")
