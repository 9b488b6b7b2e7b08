"""``monstertruckd stand``: cameras over a table that say where robots are."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from monstertruck_runtime.endpoints import DEFAULT_ENDPOINT
from monstertruck_runtime.extras import needs_extra
from monstertruckd.tools.cli.logs import finish_log, reading_log
from monstertruckd.tools.cli.options import EndpointOption
from monstertruckd.tools.cli.output import JsonOption, command_group, print_json, print_table, remark

if TYPE_CHECKING:
    from monstertruckd.tools.stand.analysis import EstimateError
    from monstertruckd.tools.stand.config import OverheadConfig

app = command_group("The overhead test stand: cameras above a table that measure the poses of robots.")

StandFile = Annotated[Path, typer.Option("--config", "-c", help="Configuration of the stand (YAML).")]


@app.command("run")
@needs_extra("vision")
def run_command(config: StandFile, endpoint: EndpointOption = DEFAULT_ENDPOINT) -> None:
    """Track the robots and send their poses to their daemons, until Ctrl-C: `mt/stand/sensor/pose_<robot>`.

    A daemon with `stand: overhead` records it. Cameras that are gone, or have moved, are reported.
    """
    from monstertruckd.tools.cli.output import until_stopped
    from monstertruckd.tools.cli.stand_session import run

    stand = _load(config)
    until_stopped(lambda clock: run(clock, stand, endpoint))


@app.command("track")
@needs_extra("vision")
def track_command(
    config: StandFile,
    out: Annotated[Path, typer.Option("--out", "-o", help="CSV: stamp, robot, x, y, yaw, sigma, cameras.")],
) -> None:
    """Poses from recorded pictures (sources of kind `file`), as a table."""
    from monstertruck_runtime.clock import run_wall
    from monstertruckd.tools.cli.stand_session import track

    count = run_wall(lambda clock: track(clock, _load(config), out))
    remark(f"wrote {count} poses to {out}")


@app.command("calibrate")
@needs_extra("vision")
def calibrate_command(config: StandFile, json_output: JsonOption = False) -> None:
    """Lenses by pictures of the board, places by the marks on the table, all cameras joined; from the folders named."""
    from monstertruckd.tools.stand.calibration import calibrate, save
    from monstertruckd.tools.stand.sources import pictures_in

    stand = _load(config)
    boards = {name: pictures_in(camera.boards) for name, camera in stand.cameras.items()}
    floors = {name: pictures_in(camera.floor) for name, camera in stand.cameras.items()}
    found = calibrate(stand, boards, floors)
    save(found, stand.calibration)
    if json_output:
        print_json(found.model_dump(mode="json"))
    else:
        rows = [
            (name, f"{c.lens_rms:.2f}", f"{1000 * c.place_rms:.1f}", str(c.boards), str(c.marks))
            for name, c in found.cameras.items()
        ]
        print_table(("camera", "lens px", "marks mm", "boards", "marks"), rows, right=("lens px", "marks mm"))
    if found.overlap_rms is None:
        remark("no mark is seen by two cameras, so their poses cannot be related: move a mark or a camera")
    else:
        remark(f"cameras agree to {1000 * found.overlap_rms:.1f} mm on the marks seen by several")
    remark(f"saved in {stand.calibration}")


@app.command("snap")
@needs_extra("vision")
def snap_command(
    config: StandFile,
    camera: Annotated[str, typer.Argument(help="Name of the camera.", show_default=False)],
    folder: Annotated[Path, typer.Argument(help="Folder for the images.", show_default=False)],
    count: Annotated[int, typer.Option(min=1, max=1000, help="Pictures.")] = 20,
    every: Annotated[float, typer.Option(min=0.0, max=60, help="Seconds between two images.")] = 2.0,
) -> None:
    """Take pictures with a camera: of the board in any pose, or of the table with its marks."""
    from monstertruckd.tools.cli.stand_session import snap

    snap(_load(config), camera, folder, count, every)
    remark(f"wrote {count} images to {folder}")


@app.command("print")
@needs_extra("vision")
def print_command(
    out: Annotated[Path, typer.Argument(help="Folder for the PNGs.", show_default=False)],
    tags: Annotated[str, typer.Option(help="Numbers of the tags: 0-3,100-134.")] = "0-3",
    columns: Annotated[int, typer.Option(min=4, max=30, help="Number of squares across the board.")] = 8,
    rows: Annotated[int, typer.Option(min=4, max=30, help="Number of squares down the board.")] = 6,
) -> None:
    """Tags and board to be printed; measure the print, and write its sizes into the stand's YAML."""
    from monstertruckd.tools.cli.stand_session import print_tags

    for path in print_tags(out, tags, columns, rows):
        remark(f"wrote {path}")


@app.command("analyse")
def analyse_command(
    log: Annotated[Path, typer.Argument(help="Log of a robot with poses from a stand.", show_default=False)],
    json_output: JsonOption = False,
) -> None:
    """Errors of odometry, pose in map and tracker against the stand, and the stand's latency."""
    from monstertruckd.recorder.reader import open_log
    from monstertruckd.tools.stand.analysis import as_values, errors_of, tracker_errors

    reader = open_log(log)
    with reading_log("analyse", log):
        found, tracker = errors_of(reader), tracker_errors(reader)
    if json_output:
        print_json({"estimates": as_values(found), "tracker": tracker})
    else:
        _print_errors(found, tracker)
    finish_log(log, reader.fault)


def _print_errors(found: "list[EstimateError]", tracker: dict[str, float] | None) -> None:
    rows = [
        (
            row.what,
            str(row.poses),
            f"{1000 * row.position_rms:.1f}",
            f"{1000 * row.position_end:.1f}",
            f"{57.2958 * row.heading_rms:.2f}",
            "-" if row.latency is None else f"{1000 * row.latency:.0f}",
        )
        for row in found
    ]
    headings = ("estimate", "poses", "rms mm", "end mm", "heading deg", "latency ms")
    print_table(headings, rows, right=headings[1:])
    if tracker is not None:
        remark(f"tracker: {1000 * tracker['rms']:.0f} mm rms deviation from its path, by its own report")


def _load(path: Path) -> "OverheadConfig":
    from monstertruckd.config.load import load_config
    from monstertruckd.tools.stand.config import OverheadConfig

    return load_config(path, OverheadConfig)[0]
