"""Commands on maps: build one from a log, show it, save a robot's map, localise in it."""

import os
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from monstertruck_runtime.endpoints import DEFAULT_ENDPOINT
from monstertruck_runtime.extras import needs_extra
from monstertruckd.tools.cli.connection import not_ready, with_robot
from monstertruckd.tools.cli.logs import finish_log
from monstertruckd.tools.cli.options import ConfigOption, EndpointOption, RobotOption, with_parameters
from monstertruckd.tools.cli.output import JsonOption, command_group, finish, print_json, progress, remark

if TYPE_CHECKING:
    from monstertruck_estimation.slam.storage import SavedMap
    from monstertruck_estimation.slam.worker_io import SlamEstimate, WorkerOutput
    from monstertruck_runtime.client import TruckClient
    from monstertruck_runtime.clock import Clock
    from monstertruckd.tools.logs.scan_log import LogGeometry, ScanLog


LABELS = {
    "log": "kind of log",
    "sources": "read from",
    "keys": "key scans",
    "closures": "loops closed",
    "rejected": "matches rejected",
    "rejected_by": "rejected because",
    "left_out": "scans left out",
    "left_out_by": "left out because",
    "odometry": "path by odometry",
    "lost_share": "path lost",
    "lidar_yaw_off": "lidar yaw off, rad",
    "lidar_yaw_deviation": "its deviation, rad",
    "path_m": "path, m",
    "standing": "status of scans",
    "odometry_ahead_s": "odometry ahead, s",
    "poses": "poses by",
}
"""Explanatory names of facts."""


class FrontChoice(StrEnum):
    """Scan matchers."""

    PLANAR = "planar"
    KISS = "kiss"


class PoseFormat(StrEnum):
    """Formats of trajectories."""

    TUM = "tum"
    KITTI = "kitti"


app = command_group("Build, show, save and use occupancy maps.")

Log = Annotated[
    Path,
    typer.Argument(
        help="MCAP, ROS 1 bag, folder of a ROS 2 bag, CARMEN text (.gz), npz or URG text (.dat).", show_default=False
    ),
]
MapPlace = Annotated[Path, typer.Argument(help="Folder of a saved map, or a map_server YAML.", show_default=False)]
Topics = Annotated[
    list[str] | None,
    typer.Option("--topic", help="Topic of the scans, or of odometry, where a log has several; may be repeated."),
]
StartAngle = Annotated[float | None, typer.Option(help="Angle of the first beam, degrees; for npz and CARMEN logs.")]
AngleIncrement = Annotated[float | None, typer.Option(help="Angle between beams, degrees; for the same logs.")]
RangeMax = Annotated[
    float | None, typer.Option(min=0.1, help="Ranges from here on mean no return, m; for the same logs.")
]
LidarMount = Annotated[
    tuple[float, float, float] | None,
    typer.Option("--mount", help="Lidar in base: x, y (m), yaw (degrees); for the same logs."),
]
Trajectory = Annotated[
    Path | None,
    typer.Option(help="Write the pose at the middle of each sweep; `build` also lists lost poses in NAME.lost.txt."),
]
TrajectoryFormat = Annotated[PoseFormat, typer.Option(help="Format of the trajectory.")]
Png = Annotated[Path | None, typer.Option("--png", help="Draw the trajectory.")]


@dataclass(frozen=True)
class ReadOptions:
    """Options for reading a log."""

    geometry: "LogGeometry"
    topics: tuple[str, ...]


def _with_read_options(command: Callable[..., None]) -> Callable[..., None]:
    """Add the options for reading a log to a command; it receives them as ``options``."""

    def run(
        *,
        topic: Topics = None,
        start_angle: StartAngle = None,
        angle_increment: AngleIncrement = None,
        range_max: RangeMax = None,
        mount: LidarMount = None,
        **own: Any,
    ) -> None:
        import math

        from monstertruckd.tools.logs.scan_log import LogGeometry

        geometry = LogGeometry(
            start_angle=None if start_angle is None else math.radians(start_angle),
            angle_increment=None if angle_increment is None else math.radians(angle_increment),
            range_max=range_max,
            mount=None if mount is None else (mount[0], mount[1], math.radians(mount[2])),
        )
        command(options=ReadOptions(geometry, tuple(topic or ())), **own)

    return with_parameters(run, command, run, without=("options",))


@app.command("build")
@_with_read_options
@needs_extra("slam")
def build(
    log: Log,
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder of the map.")] = Path("runs/map"),
    png: Png = None,
    front: Annotated[FrontChoice, typer.Option(help="Scan matcher.")] = FrontChoice.PLANAR,
    trajectory: Trajectory = None,
    trajectory_format: TrajectoryFormat = PoseFormat.TUM,
    json_output: JsonOption = False,
    *,
    options: ReadOptions,
) -> None:
    """Build a map from a log's scans, and its odometry if it has any.

    Exit code 90 (`pose_lost`) if the pose is lost on more than a tenth of the path; the map is written even so.
    """
    from monstertruck_estimation.slam.config import SlamConfig
    from monstertruck_estimation.slam.mount import mount_of
    from monstertruck_estimation.slam.worker import SlamWorker
    from monstertruck_estimation.slam.worker_io import WorkerInput
    from monstertruck_runtime.errors import InputError
    from monstertruck_schemas.reasons import Reason
    from monstertruckd.tools.logs.map_quality import PathQuality
    from monstertruckd.tools.logs.trajectory import LINES, write_trajectory

    scans = _read(log, options)
    output.mkdir(parents=True, exist_ok=True)  # minutes before it is needed
    worker = SlamWorker()
    try:
        facts, estimates = _run(worker, scans, SlamConfig.model_validate({"front": front.value}))
    except BaseException:
        with suppress(OSError):  # not empty
            output.rmdir()
        raise
    done: WorkerOutput = worker.step(WorkerInput(finish=True, whole=True, save=output, trajectory=True))
    if done.error is not None:
        raise InputError(done.error)
    assert done.whole is not None
    assert done.trajectory is not None
    assert done.on_map is not None
    quality = PathQuality.of(done.trajectory, done.on_map, estimates, scans.scans)
    facts |= {
        "path_m": quality.length,
        "odometry": quality.odometry,
        "lost_share": quality.lost_share,
        "lost_poses": int(quality.lost.sum()),
    }
    mount = mount_of(scans.scans, done.trajectory)
    if mount is not None:
        facts |= {"lidar_yaw_off": mount.yaw, "lidar_yaw_deviation": mount.deviation}
        if mount.fault is not None:
            remark(f"{log}: {mount.fault}")
    rows, columns = done.whole.cells.shape
    facts["poses"] = "joint registration" if done.joint else "graph"
    facts |= {"map": output, "width_m": columns * done.whole.resolution, "height_m": rows * done.whole.resolution}
    if trajectory is not None:
        facts["trajectory"] = write_trajectory(
            trajectory, *done.trajectory, scans, quality.lost, lines=LINES[trajectory_format]
        )
    if png is not None:
        _draw(png, _load(output))
    _print(facts, json_output)
    finish_log(log, scans.fault)
    most_lost = 0.1  # maximum share of the path with a lost pose
    if quality.lost_share > most_lost:
        text = (
            f"the pose is lost on {quality.lost_share:.0%} of the {quality.length:.1f} m path (limit: {most_lost:.0%})"
        )
        finish(Reason.POSE_LOST, f"{log}: {text}: check lidar geometry, stamps and odometry")


@app.command("show")
@needs_extra("slam")
def show(
    place: MapPlace,
    png: Png = None,
    g2o: Annotated[Path | None, typer.Option(help="Write the pose graph of the keyframes.")] = None,
    json_output: JsonOption = False,
) -> None:
    """Show the facts of a saved map."""
    from monstertruck_estimation.slam.storage import g2o_text
    from monstertruck_runtime.errors import InputError
    from monstertruck_runtime.map_files import FREE, OCCUPIED
    from monstertruck_runtime.map_folders import YAML, folder_of, opened
    from monstertruck_runtime.small_files import replace_file

    saved = _load(place)
    folder = folder_of(place)
    if folder is not None:
        with opened(folder) as save_read:
            place = save_read.file(YAML)
    cells, step = saved.grid.cells, saved.grid.resolution
    facts: dict[str, Any] = {
        "map": place,
        "resolution_m": step,
        "width_m": saved.grid.size[0],
        "height_m": saved.grid.size[1],
        "free_m2": float((cells == FREE).sum() * step**2),
        "occupied_cells": int((cells == OCCUPIED).sum()),
        "key_scans": 0 if saved.graph is None else len(saved.graph.poses),
        "relations": 0 if saved.graph is None else len(saved.graph.edges["edge_loop"]),
        "loop_relations": 0 if saved.graph is None else int(saved.graph.edges["edge_loop"].sum()),
    }
    if g2o is not None:
        if saved.graph is None:
            raise InputError(f"{place}: an occupancy grid without a pose graph: no graph for {g2o}")
        replace_file(g2o, g2o_text(saved.graph))
        facts["g2o"] = g2o
    if png is not None:
        _draw(png, saved)
    _print(facts, json_output)


@app.command("save")
@needs_extra("slam")
def save(
    output: Annotated[Path, typer.Argument(help="YAML file; its PNG is written next to it.", show_default=False)],
    robot: RobotOption = "truck",
    endpoint: EndpointOption = DEFAULT_ENDPOINT,
    timeout: Annotated[float, typer.Option(min=0.1, help="Seconds to wait for the map.")] = 5.0,
) -> None:
    """Save the map of a running robot as map_server files."""
    from monstertruck_estimation.slam.storage import trinary
    from monstertruck_estimation.slam.worker_io import GridPatch
    from monstertruck_runtime.errors import NoAnswerError
    from monstertruck_runtime.mailbox import latest
    from monstertruck_runtime.map_files import save_map
    from monstertruck_schemas.state import Grid
    from monstertruck_schemas.topics import MAP

    async def newest(client: "TruckClient", clock: "Clock") -> Grid:
        with client.subscribe(MAP, latest()) as maps:
            try:
                async with clock.deadline(timeout):
                    return await maps.next()
            except TimeoutError:
                text = f"{robot} published no map within {timeout:g} s"
                if (await client.call("config")).get("slam") is None:
                    text += ": add a section `slam` to its configuration, like the bundled `slam`"
                raise NoAnswerError(text + await not_ready(client)) from None

    grid = with_robot(newest, robot, endpoint, named=False)
    cells = grid.cells.reshape(grid.height, grid.width)
    save_map(trinary(GridPatch(cells, (grid.origin.x, grid.origin.y), grid.resolution)), output.with_suffix(".yaml"))
    remark(f"wrote {output.with_suffix('.yaml')}")


@app.command("load")
@needs_extra("slam")
def load_command(
    place: MapPlace,
    config: ConfigOption,
    output: Annotated[Path, typer.Option("--output", "-o", help="Configuration to write.")],
) -> None:
    """Write a configuration that localises the robot in a saved map; replaces one that this command wrote.

    It contains no explorer, because an explorer makes maps.
    """
    from monstertruck_runtime.errors import ConfigError, InputError
    from monstertruck_runtime.small_files import whole_file
    from monstertruck_runtime.yaml_files import read_yaml, yaml_text
    from monstertruckd.config.load import FILE_VERSION, load_truck

    _load(place)
    robot, _ = load_truck(config)
    values = {
        "include": str(config.resolve()),
        "version": FILE_VERSION,
        "slam": {"mode": "localisation", "map": str(place.resolve())},
    }
    if robot.explorer is not None:
        values["explorer"] = None
    if os.path.lexists(output) and (output.samefile(config) or not _made_by_load(read_yaml(output))):
        raise InputError(f"{output}: exists and was not written by this command; choose another file")
    with whole_file(output) as part:
        part.write_text(yaml_text(values), encoding="utf-8")
        try:
            load_truck(part)
        except ConfigError as error:
            raise ConfigError(str(error).replace(str(part), str(output))) from error
    command = "run" if robot.sim is None else "simulate --run"
    remark(f"wrote {output}: `monstertruckd {command} --config {output}` localises in {place}")


def _made_by_load(found: Any) -> bool:
    match found:
        case {"include": _, "version": _, "slam": {"mode": "localisation", "map": _, **others}, **more}:
            return not others and more in ({}, {"explorer": None})
    return False


@app.command("localise")
@_with_read_options
@needs_extra("slam")
def localise(
    log: Log,
    place: MapPlace,
    png: Png = None,
    trajectory: Trajectory = None,
    trajectory_format: TrajectoryFormat = PoseFormat.TUM,
    json_output: JsonOption = False,
    *,
    options: ReadOptions,
) -> None:
    """Localise the scans of a log in a saved map, starting from an unknown pose."""
    from monstertruck_estimation.slam.config import SlamConfig
    from monstertruck_estimation.slam.worker import SlamWorker
    from monstertruck_schemas.health import MATCHED
    from monstertruckd.tools.logs.trajectory import LINES, write_trajectory

    saved, scans = _load(place), _read(log, options)
    facts, estimates = _run(SlamWorker(), scans, SlamConfig(mode="localisation", map=place))
    known = [estimate for estimate in estimates if estimate.status in MATCHED]
    facts |= {"map": place, "localised": len(known)}
    if known:
        first = known[0]
        facts |= {"found_after_s": (first.stamp - scans.scans[0].stamp) / 1e9, "found_at": first.pose}
        facts["last_pose"] = known[-1].pose
    if trajectory is not None:
        stamps, poses = [estimate.stamp for estimate in known], [estimate.pose for estimate in known]
        facts["trajectory"] = write_trajectory(trajectory, stamps, poses, scans, lines=LINES[trajectory_format])
    if png is not None:
        _draw(png, saved, [estimate.pose for estimate in known])
    _print(facts, json_output)
    finish_log(log, scans.fault)


def _load(place: Path) -> "SavedMap":
    """Read a saved map and print its remarks."""
    from monstertruck_estimation.slam.storage import load

    saved = load(place)
    for text in saved.grid.remarks:
        remark(text)
    return saved


def _read(path: Path, options: ReadOptions) -> "ScanLog":
    """Read a log; print a remark about assumed geometry."""
    import math

    with needs_extra("logs"):
        from monstertruckd.tools.logs.scans import read_scans

        log = read_scans(path, options.geometry, options.topics)
    if log.assumed:
        scan = log.scans[0]
        first, step = math.degrees(scan.start_angle), math.degrees(scan.angle_increment)
        x, y, yaw = scan.mount
        values = {
            "start_angle": f"first beam at {first:g} degrees",
            "angle_increment": f"{len(scan.ranges)} beams {step:g} degrees apart",
            "range_min": f"returns from {scan.range_min:g} m on",
            "range_max": f"no return from {scan.range_max:g} m on",
            "time_increment": f"{scan.time_increment:g} s between beams",
            "mount": f"lidar at x {x:g}, y {y:g} m, yaw {math.degrees(yaw):g} degrees",
        }
        remark(
            f"{path}: contains no {', '.join(log.assumed)}; assuming {', '.join(values[name] for name in log.assumed)}"
        )
    return log


def _run(worker: Any, log: "ScanLog", config: Any) -> tuple[dict[str, Any], list["SlamEstimate"]]:
    """Process every scan by the worker; return facts to print, and the estimates.

    Raises:
        InputError: no scan was usable.
    """
    from monstertruck_estimation.slam.worker_io import Start, WorkerInput
    from monstertruck_runtime.errors import InputError
    from monstertruckd.tools.logs.map_quality import verdicts

    first = log.scans[0].odom or (0.0, 0.0, 0.0)
    worker.step(WorkerInput(start=Start(config, first)))
    estimates: list[SlamEstimate] = []
    refused: str | None = None
    left_out: Counter[str] = Counter()
    counts: dict[str, int] = {}
    with progress("scans", len(log.scans)) as advance:
        for number, scan in enumerate(log.scans, start=1):
            outputs: WorkerOutput = worker.step(WorkerInput(scan=scan))
            if outputs.left_out is not None:
                refused = outputs.refused
                left_out[outputs.left_out.value] += 1
            counts = outputs.counts
            if outputs.estimate is not None:
                estimates.append(outputs.estimate)
            advance(number)
    if not estimates:
        raise InputError(f"{log.make} log: none of its {len(log.scans)} scans is usable; the last one: {refused}")
    statuses = Counter(estimate.status.value for estimate in estimates)
    offsets = [estimate.offset for estimate in estimates if estimate.offset is not None]
    facts: dict[str, Any] = {
        "log": log.make,
        **({"sources": log.sources} if log.sources else {}),
        "seconds": (log.scans[-1].stamp - log.scans[0].stamp) / 1e9,
        **counts,
        "rejected_by": verdicts(estimates),
        "left_out": left_out.total(),
        "left_out_by": dict(left_out),
        "standing": dict(statuses),
        "odometry_ahead_s": offsets[-1] if offsets else None,
    }
    return facts, estimates


def _print(facts: dict[str, Any], json_output: bool) -> None:
    if json_output:
        print_json(facts)
        return
    for name, value in facts.items():
        print(f"{LABELS.get(name, name.replace('_', ' ')):18} {_text(value)}")


def _text(value: Any) -> str:
    """Format a fact for display."""
    if isinstance(value, float):
        return f"{value:.2f}"
    if isinstance(value, dict):
        return ", ".join(f"{_text(part)} {name}" for name, part in value.items()) or "-"
    if isinstance(value, tuple | list):
        return " ".join(_text(part) for part in value)
    return "-" if value is None else str(value)


def _draw(path: Path, saved: Any, places: Any = ()) -> None:
    """Draw the grid with the poses of its keyframes, or with another path."""
    import numpy as np

    from monstertruckd.tools.cli.kinematics import figure

    grid = saved.grid
    shades = np.choose(grid.cells.astype(int) // 100 + 1, (0.8, 1.0, 0.0))
    (x0, y0), (width, height) = grid.origin, grid.size
    poses = np.array(places).reshape(-1, 3) if len(places) or saved.graph is None else saved.graph.poses
    with figure(path, "x, m", "y, m") as axes:
        extent = (x0, x0 + width, y0, y0 + height)
        axes.imshow(shades, cmap="gray", vmin=0, vmax=1, origin="lower", extent=extent, interpolation="nearest")
        axes.plot(
            poses[:, 0],
            poses[:, 1],
            color="#e0482f",
            linewidth=1.2,
            label="localised" if len(places) else "keyframes",
        )
        axes.legend(loc="upper right")
        axes.set_aspect("equal")
