"""``monstertruckd kinematics``: families, mobility, turning radii, steering linkage, identification."""

import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final

import typer

from monstertruckd.tools.cli.output import JsonOption, command_group, print_json, print_table, remark

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from monstertruck_kinematics.identification import SkidModel
    from monstertruck_kinematics.truck import SteeringModeName
    from monstertruck_kinematics.wheels import Wheel

app = command_group("Kinematics of the truck and of all wheeled-robot families.")

Png = Annotated[Path | None, typer.Option("--png", help="Also write a figure to this file.")]
Family = Annotated[str, typer.Argument(help="Drive family; `kinematics show` lists them.")]
Settings = Annotated[list[str] | None, typer.Option("--set", "-s", help="Parameter as name=value, repeatable.")]
Wheelbase = Annotated[float, typer.Option(help="Wheelbase, m.")]
Track = Annotated[float, typer.Option(help="Track, m.")]
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


@contextmanager
def refusals() -> Iterator[None]:
    """Convert errors of the kinematics library to command-line errors.

    Raises:
        InputError: the block raised a KinematicsError.
    """
    from monstertruck_kinematics.elementary import KinematicsError
    from monstertruck_runtime.errors import InputError

    try:
        yield
    except KinematicsError as error:
        raise InputError(str(error)) from error


def text(value: object) -> str:
    """A fact as a word or a number."""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, tuple):
        return ", ".join(text(entry) for entry in value)
    return f"{value:.4g}" if isinstance(value, float) else str(value)


@contextmanager
def figure(path: Path, across: str, up: str) -> Iterator[Any]:
    """Axes of a figure that is written when the block ends.

    Raises:
        NotInstalledError: matplotlib is not installed.
        InputError: the file cannot be written.
    """
    from monstertruckd.tools.figures import new_figure, write_figure

    drawing = new_figure(7.0, 5.0)
    axes = drawing.add_subplot()
    axes.set_xlabel(across)
    axes.set_ylabel(up)
    axes.grid(visible=True, alpha=0.3)
    yield axes
    write_figure(drawing, path, "png")
    remark(f"wrote {path}")


@app.command("show")
def show_command(
    family: Annotated[str | None, typer.Argument(help="Show one family in detail.")] = None,
    settings: Settings = None,
    json_output: JsonOption = False,
) -> None:
    """Print the drive families, or one in detail: inputs, parameters, mobility."""
    from monstertruck_kinematics.families import FAMILIES, build_drive, parameters_of
    from monstertruck_kinematics.wheels import analyse

    with refusals():
        drives = {kind: build_drive(kind, **_parsed(settings)) for kind in ([family] if family else FAMILIES)}
    mobilities = {kind: analyse(drive.wheels((0.0,) * len(drive.inputs))) for kind, drive in drives.items()}
    parameters = {kind: parameters_of(kind) | _parsed(settings) for kind in drives}
    if json_output:
        print_json(
            [
                {
                    "family": kind,
                    "class": mobilities[kind].robot_class,
                    "non_holonomic": mobilities[kind].non_holonomic,
                    "inputs": drive.inputs,
                    "parameters": parameters[kind],
                }
                for kind, drive in drives.items()
            ]
        )
        return
    print_table(
        ("family", "class (m, s)", "non-holonomic", "inputs"),
        [
            (kind, f"({text(mobilities[kind].robot_class)})", text(mobilities[kind].non_holonomic), text(drive.inputs))
            for kind, drive in drives.items()
        ],
    )
    if family:
        print_table(("parameter", "value"), [(name, text(v)) for name, v in parameters[family].items()])


@app.command("mobility", context_settings={"ignore_unknown_options": True})
def mobility_command(
    family: Family = "truck",
    command: Annotated[list[float] | None, typer.Argument(help="Drive inputs that set the steering angles.")] = None,
    settings: Settings = None,
    wheels: Annotated[
        Path | None, typer.Option("--wheels", "-w", help="YAML list of wheels instead of a family.")
    ] = None,
    png: Png = None,
    json_output: JsonOption = False,
) -> None:
    """Print the degrees of mobility, steerability and manoeuvrability, and the turning centre."""
    from monstertruck_kinematics.families import build_drive
    from monstertruck_kinematics.wheels import analyse

    with refusals():
        if wheels is not None:
            chosen: tuple[Wheel, ...] = _read_wheels(wheels)
        else:
            drive = build_drive(family, **_parsed(settings))
            chosen = drive.wheels(command or (0.0,) * len(drive.inputs))
        mobility = analyse(chosen)
    facts = {
        "mobility": mobility.mobility,
        "steerability": mobility.steerability,
        "manoeuvrability": mobility.manoeuvrability,
        "non_holonomic": mobility.non_holonomic,
        "turning_centre": mobility.icr_kind,
        "turning_centre_at": mobility.icr,
        "turning_centre_line": mobility.icr_line,
    }
    if json_output:
        print_json(facts)
    else:
        shown = {name: value for name, value in facts.items() if value is not None}
        print_table(("of these wheels", "value"), [(name, text(value)) for name, value in shown.items()])
        print_table(
            ("wheel", "kind", "x m", "y m", "heading deg"),
            [(w.name, type(w).__name__, f"{w.x:.3f}", f"{w.y:.3f}", f"{math.degrees(w.heading):.2f}") for w in chosen],
            right=("x m", "y m", "heading deg"),
        )
    if png:
        _draw_wheels(png, chosen, mobility.icr)


@app.command("radius-table")
def radius_table_command(
    limits: Annotated[list[float] | None, typer.Option("--limit", "-l", help="Maximum angle, degrees.")] = None,
    wheelbase: Wheelbase = 0.32,
    track: Track = 0.26,
    png: Png = None,
    json_output: JsonOption = False,
) -> None:
    """Print the minimum turning radius by steering mode and steering limit."""
    from monstertruck_kinematics.truck import FourWheelSteering

    modes: tuple[SteeringModeName, ...] = ("front", "rear", "counter", "crab", "spot")
    degrees = limits or [22.5, math.degrees(0.4), 25.0]
    with refusals():
        geometry = FourWheelSteering(wheelbase, track)
        table = [
            (
                mode,
                limit,
                geometry.minimum_radius(mode, math.radians(limit)),
                geometry.minimum_radius(mode, math.radians(limit), every_wheel=True),
            )
            for mode in modes
            for limit in degrees
        ]
    if json_output:
        names = ("mode", "limit_deg", "radius", "radius_every_wheel")
        print_json([dict(zip(names, row, strict=True)) for row in table])
    else:
        print_table(
            ("mode", "limit deg", "radius m", "if no wheel exceeds the limit, m"),
            [(mode, f"{limit:.1f}", f"{axle:.3f}", f"{every:.3f}") for mode, limit, axle, every in table],
            right=("limit deg", "radius m", "if no wheel exceeds the limit, m"),
        )
    if png:
        angles = [5.0 + 0.25 * i for i in range(141)]
        steered: tuple[SteeringModeName, ...] = ("front", "counter")
        with figure(png, "steering limit, deg", "minimum turning radius, m") as axes:
            for mode in steered:
                radii = [geometry.minimum_radius(mode, math.radians(a)) for a in angles]
                axes.plot(angles, radii, label=f"{mode} steering")
            axes.legend()


@app.command("linkage")
def linkage_command(
    pitman: Annotated[float, typer.Option(help="Servo arm, m.")] = 0.020,
    drag_link: Annotated[float, typer.Option(help="Drag link, m.")] = 0.060,
    arm: Annotated[float, typer.Option(help="Wheel arm, m.")] = 0.025,
    arm_angle: Annotated[float, typer.Option(help="Wheel arm's inward angle, degrees.")] = 15.0,
    king_pins: Annotated[float, typer.Option(help="Distance between the king-pins, m.")] = 0.200,
    arms: Annotated[str, typer.Option(help="forward or rearward.")] = "rearward",
    polynomials: Annotated[str, typer.Option(help="corrected, as_published or 2016.")] = "corrected",
    png: Png = None,
    json_output: JsonOption = False,
) -> None:
    """Print wheel angles over the servo angle: a linkage compared with the truck's fitted front polynomials.

    The real lengths of the truck are unpublished; the defaults are an example of the right size.
    """
    import numpy as np

    from monstertruck_kinematics.linkage import SteeringLinkage, reachable_servo
    from monstertruck_kinematics.polynomials import SteeringPolynomials
    from monstertruck_kinematics.steered import Ackermann

    with refusals():
        linkage = SteeringLinkage(pitman, drag_link, arm, math.radians(arm_angle), king_pins, arms)  # type: ignore[arg-type]
        axle = SteeringPolynomials.named(polynomials).front  # type: ignore[arg-type]
        right_end, left_end = reachable_servo(linkage)
        servo = np.radians(np.arange(-45.0, 45.1, 5.0))
        servo = servo[(servo >= right_end) & (servo <= left_end)]
        left, right = linkage.wheels_from_servo(servo)
        fitted_left, fitted_right = axle.wheels_from_servo(servo)
    car = Ackermann()
    columns = {
        "servo": servo,
        "linkage_left": left,
        "linkage_right": right,
        "linkage_ackermann_defect": car.defect(left, right),
        "fitted_left": fitted_left,
        "fitted_right": fitted_right,
        "fitted_ackermann_defect": car.defect(fitted_left, fitted_right),
    }
    if json_output:
        print_json({name: values.tolist() for name, values in columns.items()})
    else:
        rows = [
            tuple(
                f"{v:z.4f}" if "defect" in n else f"{math.degrees(v):z.2f}" for n, v in zip(columns, row, strict=True)
            )
            for row in zip(*columns.values(), strict=True)
        ]
        headings = tuple(n.replace("_", " ") for n in columns)
        print_table(headings, rows, right=headings)
        typer.echo("angles in degrees; defect: tan l - tan r - (w/L) tan l tan r, 0 for ideal Ackermann wheels")
    if png:
        with figure(png, "servo, deg", "wheel, deg") as axes:
            for name in ("linkage_left", "linkage_right", "fitted_left", "fitted_right"):
                axes.plot(np.degrees(servo), np.degrees(columns[name]), label=name.replace("_", " "))
            axes.legend()


def _parsed(settings: list[str] | None) -> dict[str, float | str]:
    from monstertruck_runtime.errors import InputError

    values: dict[str, float | str] = {}
    for setting in settings or []:
        name, equals, text = setting.partition("=")
        if not equals:
            raise InputError(f"--set {setting}: expected name=value")
        try:
            values[name] = float(text)
        except ValueError:
            values[name] = text
    return values


def _read_wheels(path: Path) -> "tuple[Wheel, ...]":
    """Wheels from YAML: a list of mappings with `kind` (fixed, steered, caster, swedish) and the wheel's fields."""
    from monstertruck_kinematics.wheels import CasterWheel, FixedWheel, SteeredWheel, SwedishWheel, checked
    from monstertruck_runtime.errors import InputError
    from monstertruck_runtime.outside import reading
    from monstertruck_runtime.yaml_files import read_yaml

    kinds: dict[str, type[Wheel]] = {
        "fixed": FixedWheel,
        "steered": SteeredWheel,
        "caster": CasterWheel,
        "swedish": SwedishWheel,
    }
    rows = read_yaml(path)
    if not isinstance(rows, list):
        raise InputError(f"{path}: expected a list of wheels")
    wheels: list[Wheel] = []
    for number, row in enumerate(rows, start=1):
        if not isinstance(row, dict) or str(row.get("kind")) not in kinds:
            raise InputError(f"{path}: wheel {number}: expected a mapping with kind {', '.join(kinds)}")
        fields = {"name": str(number)} | {name: value for name, value in row.items() if name != "kind"}
        for name, value in fields.items():
            if name not in ("name", "group") and not isinstance(value, int | float):
                raise InputError(f"{path}: wheel {number}: {name} is {value!r}: expected a number")
        try:
            with reading(f"{path}: wheel {number}", "a wheel"):
                wheels.append(kinds[str(row["kind"])](**fields))
        except InputError as error:
            if not isinstance(cause := error.__cause__, TypeError):
                raise
            raise InputError(f"{path}: wheel {number}: {str(cause).partition('__init__() ')[2]}") from cause
    with reading(path, "wheels"):
        return checked(wheels)


def _draw_wheels(path: Path, wheels: "tuple[Wheel, ...]", icr: tuple[float, float] | None) -> None:
    with figure(path, "y, m (left)", "x, m (forward)") as axes:
        for wheel in wheels:
            along, aside = math.cos(wheel.heading), math.sin(wheel.heading)
            ends = (-wheel.radius, wheel.radius)
            axes.plot([wheel.y + e * aside for e in ends], [wheel.x + e * along for e in ends], linewidth=6.0)
            axes.annotate(wheel.name, (wheel.y, wheel.x))
            if icr is not None and wheel.sliding_row is not None:
                axes.plot([wheel.y, icr[1]], [wheel.x, icr[0]], color="grey", linewidth=0.7)
        axes.set_aspect("equal")
        axes.invert_xaxis()


@app.command("fit")
def fit(
    trajectory: Annotated[
        Path | None, typer.Argument(help="CSV: time, left, right (rad/s), x, y (m), heading (rad). Default: paper.")
    ] = None,
    model: Annotated[str | None, typer.Option(help="Only this model.")] = None,
    radius: Annotated[float, typer.Option(help="Nominal wheel radius, m.")] = 0.021,
    half_track: Annotated[float, typer.Option(help="Half the left-right wheel distance, m.")] = 0.0525,
    window: Annotated[int, typer.Option(help="Samples over which motion is compared.")] = 10,
    bounded: Annotated[bool, typer.Option(help="Plausible parameters only.")] = True,
    png: Annotated[Path | None, typer.Option("--png", help="Also write a figure to this file.")] = None,
    json_output: JsonOption = False,
) -> None:
    """Identify a skid-steer robot from a trajectory, or from the circles of the skid-steer paper."""
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
        typer.echo(f"{f.model.name}: rms {f.fit.rms:.3f} times the expected noise")
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
    from monstertruck_kinematics.unsteered import SkidSteer

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
    heads = ("maximum error when fitted to fewer data, %", "all radii, no speeds", "2:1 and 3:1, both")
    print_table(heads, [(name, f"{radii[name]:.1f}", f"{driven[name]:.1f}") for name in driven], right=heads[1:])
    print(
        f"\nThe measurements at equal ratios differ by up to {floor:.1f} % from one common speed per rate: no "
        "model explains this."
    )
    if png:
        _draw_errors(png, {name: abs(e).max(axis=0) for name, e in errors.items()})


def _read_trajectory(path: Path) -> "NDArray[Any]":
    """(6, N) columns of a CSV with or without a heading line."""
    import numpy as np

    from monstertruck_runtime.errors import InputError
    from monstertruck_runtime.outside import MOST_UNPACKED
    from monstertruck_runtime.tables import read_table

    rows = []
    for index, (number, cells) in enumerate(read_table(path, "a table of six numbers", MOST_UNPACKED)):
        try:
            rows.append([float(cell) for cell in cells])
        except ValueError as error:
            if index:
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
