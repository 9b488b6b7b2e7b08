"""Kinds of files supplied by users or found by the daemon: intact ones, and the functions that read them.

If a command does more than call one function, its own function is called, with its output discarded.
"""

import asyncio
import gzip
import json
import math
import random
import shutil
from collections.abc import Callable
from contextlib import AbstractContextManager
from functools import cache
from pathlib import Path
from typing import Any, Final, NamedTuple

import cv2
import numpy as np
from PIL import Image
from pydantic import TypeAdapter
from rosbags.rosbag2 import StoragePlugin
from typer.testing import CliRunner

from benchmarks import ROOT
from benchmarks.durability_parts import maps
from benchmarks.durability_parts.damage import made
from benchmarks.durability_parts.state import missions
from monstertruck_drivers.hokuyo_urg.recording import RecordedRanges
from monstertruck_drivers.usb.config import UsbPortConfig
from monstertruck_estimation.ground.grid import GroundGrid
from monstertruck_estimation.points import files as points
from monstertruck_estimation.slam import storage
from monstertruck_estimation.slam.storage import surface_elements
from monstertruck_planners.missions.progress import MissionFrame, MissionProgress, SavedProgress
from monstertruck_planners.track.paths import load_path
from monstertruck_runtime import wire
from monstertruck_runtime.clock import SECOND, WallClock
from monstertruck_runtime.errors import InputError
from monstertruck_runtime.map_files import load_map
from monstertruck_runtime.stations import TLS_VARIABLE, station_tls
from monstertruck_schemas.base import Message, Pose2D, Twist2D
from monstertruck_schemas.mission import Mission
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import DriveRequest, Role
from monstertruck_schemas.roles import AccessRole
from monstertruck_schemas.sensor import StandPose
from monstertruck_schemas.state import Odometry
from monstertruck_schemas.topics import ODOMETRY, REQ_DRIVE, STAND_POSE, Topic
from monstertruck_sim.world.config import HeightImage
from monstertruck_sim.world.terrain import load_profile
from monstertruck_sim.world3d.ground import _pictured, scenery
from monstertruckd.bus.local import Bus
from monstertruckd.bus.rpc import Rpc
from monstertruckd.bus.zenoh_config import ZenohConfig
from monstertruckd.bus.zenoh_session import ZenohBridge
from monstertruckd.config import migrate
from monstertruckd.config.calibration import CalibrationStore
from monstertruckd.config.expiry import DistanceCounter
from monstertruckd.config.load import SavedSettings, Tree, load_config, load_truck
from monstertruckd.config.start import started
from monstertruckd.recorder.config import Compression
from monstertruckd.recorder.log_file import LogEntry, LogFile
from monstertruckd.recorder.reader import open_log
from monstertruckd.recorder.repair import recover, recover_directory
from monstertruckd.station.pilot import read_mission
from monstertruckd.station.replay import ReplayFeed
from monstertruckd.station.users import StationUsers, add_user
from monstertruckd.tools.cli import logs as cli_logs
from monstertruckd.tools.cli.find_port import write_port
from monstertruckd.tools.cli.kinematics import _read_trajectory, _read_wheels
from monstertruckd.tools.cli.main import app
from monstertruckd.tools.cli.station import _tls
from monstertruckd.tools.demo.runs import free_endpoint
from monstertruckd.tools.drill.legs import DrillLeg, LegFile
from monstertruckd.tools.driving.gamepad import read_mapping
from monstertruckd.tools.logs.animation import animate
from monstertruckd.tools.logs.export import export_csv, export_mcap, export_npz
from monstertruckd.tools.logs.messages import Selection
from monstertruckd.tools.logs.replay import replay_log
from monstertruckd.tools.logs.report.collect import collect
from monstertruckd.tools.logs.rerun_view import convert
from monstertruckd.tools.logs.ros2 import export_ros2
from monstertruckd.tools.logs.scans import read_scans
from monstertruckd.tools.logs.summary import info
from monstertruckd.tools.security import certificates
from monstertruckd.tools.security.folder import Folder
from monstertruckd.tools.simulation.config import SimulatedTruckConfig
from monstertruckd.tools.stand import calibration as stand
from monstertruckd.tools.stand.config import FileSource, OverheadConfig
from monstertruckd.tools.stand.sources import pictures_in, stream
from tests.unit.tools.logs.bag_kit import (
    ROS1,
    ROS2,
    RosMessages,
    drive,
    write_foxglove,
    write_json,
    write_ros1,
    write_ros2,
)

RUN: Final = 1.0
"""Seconds of the log of a drive."""
AT_ONCE: Final = 1e12
"""Speed of a replay that waits for no message."""
DATA: Final = ROOT / "tests" / "data"
CONFIGS: Final = ROOT / "configs"


class Kind(NamedTuple):
    """Files of one kind.

    Args:
        make: writes intact ones into an empty folder; the mutated ones are among them.
        read: reads the folder like a command or the daemon.
        share: relative frequency; slow kinds are tried less often.
    """

    make: Callable[[Path], object]
    read: Callable[[Path], object]
    share: int = 8


def kinds() -> dict[str, Kind]:
    """Return all kinds by name."""
    return {
        "map": Kind(_map, lambda it: surface_elements(load_map(it / "m.yaml"))),
        "map16": Kind(_map16, lambda it: load_map(it / "m.yaml")),
        "saved map": Kind(_saved, _read_saved),
        "log": Kind(_log, _read_log),
        "log of a run": Kind(_run, _read_run, 1),
        "log replayed": Kind(_run, _read_replayed, 1),
        "log on the page": Kind(_run, _read_page),
        "log viewed": Kind(_run, _read_viewed, 1),
        "log animated": Kind(_run, _read_animated, 1),
        "log as CSV": Kind(_run, _exported(lambda it: export_csv(it / "log.mcap", it / "csv")), 1),
        "log as npz": Kind(_run, _exported(lambda it: export_npz(it / "log.mcap", it / "npz")), 1),
        "log as MCAP": Kind(_run, _exported(lambda it: export_mcap(it / "log.mcap", it / "dated.mcap")), 1),
        "log as ROS 2 bag": Kind(_run, _exported(lambda it: export_ros2(it / "log.mcap", it / "bag")), 1),
        "scans npz": Kind(_npz, lambda it: read_scans(it / "log.npz")),
        "scans CARMEN": Kind(_carmen, lambda it: read_scans(it / "log.log")),
        "scans CARMEN, packed": Kind(_carmen_packed, lambda it: read_scans(it / "log.gz")),
        "scans URG": Kind(_urg, lambda it: (read_scans(it / "log.dat"), RecordedRanges.load(it / "log.dat"))),
        "scans of ROS 1": Kind(_ros1, lambda it: read_scans(it / "log.bag"), 1),
        "scans of ROS 2": Kind(_ros2, lambda it: read_scans(it / "bag"), 1),
        "scans of ROS 2, MCAP": Kind(_ros2_mcap, lambda it: read_scans(it / "bag"), 1),
        "scans of Foxglove": Kind(_foxglove, lambda it: read_scans(it / "log.mcap"), 1),
        "scans as JSON": Kind(_json, lambda it: read_scans(it / "log.mcap"), 1),
        "path": Kind(_path, lambda it: load_path(it / "p.csv", closed=False)),
        "trajectory": Kind(_trajectory, lambda it: _read_trajectory(it / "t.csv")),
        "wheels": Kind(_wheels, lambda it: _read_wheels(it / "w.yaml")),
        "mission": Kind(_mission, lambda it: load_config(it / "m.yaml", Mission)),
        "configuration": Kind(_config, lambda it: load_truck(it / "truck.yaml")),
        "live settings": Kind(_settings, _read_settings),
        "saved mission": Kind(_progress, _read_progress),
        "users": Kind(_users, _read_users),
        "gamepad": Kind(_gamepad, lambda it: read_mapping(it / "pad.yaml")),
        "profile": Kind(_profile, lambda it: load_profile(it / "h.profile.yaml")),
        "height picture": Kind(_heights, _read_heights),
        "mjcf": Kind(_mjcf, lambda it: scenery(it / "s.xml")),
        "stations": Kind(_stations, lambda it: Folder(it / "security").register()),
        "certificate": Kind(_certificate, lambda it: certificates.load(it / "c.pem", it / "k.pem")),
        "calibration": Kind(_calibration, _read_calibration),
        "stand": Kind(_stand, lambda it: stand.load(it / "stand.json")),
        "odometer": Kind(_odometer, lambda it: DistanceCounter(it / "odometer.json").load()),
        "map planned over": Kind(_map, _read_planned, 1),
        "saved map localised in": Kind(_localised, _read_localised, 1),
        "scans built into a map": Kind(_npz, lambda it: command("map", "build", it / "log.npz", "-o", it / "map"), 1),
        "log built into a map": Kind(_run, lambda it: command("map", "build", it / "log.mcap", "-o", it / "map"), 1),
        "log checked": Kind(_run, _read_checked, 1),
        "log reported": Kind(_run, lambda it: command("log", "report", it / "log.mcap", "-o", it / "report.html"), 1),
        "log of a study": Kind(_study, _read_study, 1),
        "folder of logs": Kind(_folder, _read_folder, 1),
        "outcomes of a drill": Kind(_drill, _read_drill, 1),
        "old configuration": Kind(_old, lambda it: command("config", "migrate", it / "truck.yaml"), 1),
        "configuration with a port": Kind(_with_port, _read_with_port, 1),
        "certificate of the page": Kind(_certificate, lambda it: _tls(it / "c.pem", it / "k.pem")),
        "certificates of the robot": Kind(_stations, _read_robot_tls),
        "certificates of a station": Kind(_station, _read_station_tls),
        "authority": Kind(_stations, _read_authority, 1),
        "mission on the page": Kind(_mission, _read_uploaded),
        "configuration of a stand": Kind(_stand_config, lambda it: load_config(it / "stand.yaml", OverheadConfig)),
        "pictures of a stand": Kind(_stand_pictures, pictures_in),
        "film of a stand": Kind(_film, _read_film),
    }


def command(*words: str | Path, allowed: Reason = Reason.OK) -> None:
    """Run a command line, with its output discarded.

    Args:
        words: words of the command line.
        allowed: permitted reason of its end, besides ``OK``.

    Raises:
        TruckError: its exit code is different.
        Exception: any exception that it does not convert to an exit code.
    """
    done = CliRunner().invoke(app, [str(word) for word in words])
    if done.exception is not None and not isinstance(done.exception, SystemExit):
        raise done.exception
    if done.exit_code not in (0, allowed.exit_code):
        raise InputError(done.stderr.strip())


# Sound files


def _map(folder: Path) -> None:
    cells = np.full((60, 80), 254, np.uint8)
    cells[:, 20], cells[40] = 0, 205
    Image.fromarray(cells).save(folder / ("m.png" if len(folder.name) % 2 else "m.pgm"))
    _map_yaml(folder, "m.png" if len(folder.name) % 2 else "m.pgm")


def _map_yaml(folder: Path, image: str) -> None:
    text = f"image: {image}\nmode: trinary\nresolution: 0.05\norigin: [-1.0, -2.0, 0.0]\nnegate: 0\n"
    (folder / "m.yaml").write_text(text + "occupied_thresh: 0.65\nfree_thresh: 0.196\n")


def _map16(folder: Path) -> None:
    Image.fromarray(np.full((30, 30), 40_000, np.uint16)).save(folder / "m.tif")
    _map_yaml(folder, "m.tif")


def _saved(folder: Path) -> None:
    for _ in zip(range(3), maps.write(folder, 1), strict=False):
        pass


def _read_saved(folder: Path) -> None:
    storage.load(folder / "map")
    GroundGrid.load(folder / "map")
    points.load(folder / "map")


_LOGS: dict[Compression, bytes] = {}


def _log(folder: Path) -> None:
    kind = random.Random(len(str(folder))).choice(tuple(Compression))
    if kind not in _LOGS:
        _LOGS[kind] = made(folder, kind, finished=True).data
        next(folder.glob("*.mcap")).unlink()
    (folder / "log.mcap").write_bytes(_LOGS[kind])


def _read_log(folder: Path) -> None:
    info(folder / "log.mcap")
    recover(folder / "log.mcap", folder / "fixed.mcap")
    info(folder / "fixed.mcap")


def _run(folder: Path) -> None:
    """Record the first second of a drive, with all topics."""
    export_mcap(max(DATA.glob("golden/*/run.mcap")), folder / "log.mcap", Selection(end=RUN))


def _read_run(folder: Path) -> None:
    info(folder / "log.mcap")
    read_scans(folder / "log.mcap")
    with as_a_command(folder / "log.mcap"):
        collect(folder / "log.mcap")


def as_a_command(log: Path) -> AbstractContextManager[object]:
    """Context in which every command on logs reads this one."""
    return cli_logs.reading_log("read", log)


def _read_replayed(folder: Path) -> None:
    with as_a_command(folder / "log.mcap"):
        replay_log(folder / "log.mcap", "truck", free_endpoint(), AT_ONCE, None)


def _read_page(folder: Path) -> None:
    ReplayFeed("log", folder / "log.mcap", open_log, WallClock())


def _read_viewed(folder: Path) -> None:
    with as_a_command(folder / "log.mcap"):
        convert(open_log(folder / "log.mcap"), folder / "log.rrd")


def _read_animated(folder: Path) -> None:
    with as_a_command(folder / "log.mcap"):
        animate(open_log(folder / "log.mcap"), folder / "log.gif", speed=8.0, width=64)


def _exported(export: Callable[[Path], object]) -> Callable[[Path], None]:
    """Return a function that exports the log of a folder like the command."""

    def read(folder: Path) -> None:
        with as_a_command(folder / "log.mcap"):
            export(folder)

    return read


def _npz(folder: Path) -> None:
    times, ranges = np.arange(5) / 10.0, np.full((5, 40), 3.0)
    np.savez_compressed(folder / "log.npz", t=times, ranges=ranges, odom=np.zeros((5, 3)), range_max=np.array(5.0))


def _carmen(folder: Path) -> None:
    row = "FLASER 20 " + " ".join(["2.5"] * 20) + " 0.1 0.2 0.3 0.1 0.2 0.3 {} host {}\n"
    (folder / "log.log").write_text("# a comment\n" + "".join(row.format(i / 5, i / 5) for i in range(6)))


def _carmen_packed(folder: Path) -> None:
    _carmen(folder)
    (folder / "log.gz").write_bytes(gzip.compress((folder / "log.log").read_bytes()))
    (folder / "log.log").unlink()


def _urg(folder: Path) -> None:
    with gzip.open(DATA / "urg04lx_exp2.dat.gz") as file:
        (folder / "log.dat").write_bytes(b"".join(file.readline() for _ in range(3)))


def _ros1(folder: Path) -> None:
    write_ros1(folder / "log.bag", drive(RosMessages(ROS1)))


def _ros2(folder: Path) -> None:
    write_ros2(folder / "bag", drive(RosMessages(ROS2)))


def _ros2_mcap(folder: Path) -> None:
    write_ros2(folder / "bag", drive(RosMessages(ROS2)), StoragePlugin.MCAP)


def _foxglove(folder: Path) -> None:
    write_foxglove(folder / "log.mcap")


def _json(folder: Path) -> None:
    write_json(folder / "log.mcap")


def _path(folder: Path) -> None:
    (folder / "p.csv").write_text("x,y,yaw,direction\n" + "".join(f"{i / 10},0.0,0.0,1\n" for i in range(12)))


def _trajectory(folder: Path) -> None:
    (folder / "t.csv").write_text("time,left,right,x,y,heading\n" + "".join(f"{i},1,1,{i},0,0\n" for i in range(9)))


def _wheels(folder: Path) -> None:
    rows = ("kind: fixed, x: 0.1, y: 0.1", "kind: steered, x: 0.3, y: 0.0")
    (folder / "w.yaml").write_text("".join(f"- {{{row}, radius: 0.07}}\n" for row in rows))


def _mission(folder: Path) -> None:
    steps = "steps:\n- do: wait\n  seconds: 3\n- do: goto\n  x: 1.0\n  y: 2.0\n  yaw: 0.5\n"
    (folder / "m.yaml").write_text("version: 2\nname: round\n" + steps)


def _config(folder: Path) -> None:
    text = (CONFIGS / "demo.yaml").read_text(encoding="utf-8")
    text = text.replace("include: ", f"include: {CONFIGS}/").replace(" paths/", f" {CONFIGS}/paths/")
    (folder / "truck.yaml").write_text(text, encoding="utf-8")


@cache
def _demo() -> tuple[SimulatedTruckConfig, Tree]:
    return load_config(CONFIGS / "demo.yaml", SimulatedTruckConfig)


def _settings(folder: Path) -> None:
    SavedSettings(folder, "truck").save({"gate.speed": 0.15, "gate.obstacle.ahead": 0.1})


def _read_settings(folder: Path) -> None:
    config, tree = _demo()
    started(config.model_copy(update={"state_directory": folder}), tree)


def _progress(folder: Path) -> None:
    _mission(folder)
    mission, _ = load_config(folder / "m.yaml", Mission)
    progress = SavedProgress.of(MissionProgress(mission, (0.0, 0.0, 0.0), (MissionFrame(index=1),)), "ann")
    (folder / "m.yaml").unlink()
    (folder / "mission.json").write_text(progress.model_dump_json())


def _read_progress(folder: Path) -> None:
    missions(folder / "mission.json")._load()  # noqa: SLF001 - as the service's start does


def _stations(folder: Path) -> None:
    certified = Folder(folder / "security")
    certified.init("truck", ("127.0.0.1",), folder / "security" / "robot", 1_700_000_000)
    certified.add("station", None, None, 1_700_000_000)


def _users(folder: Path) -> None:
    add_user(folder / "users.yaml", "ann", AccessRole.PILOT, "password")


def _read_users(folder: Path) -> None:
    (folder / "users.yaml").chmod(0o600)
    StationUsers(folder / "users.yaml")


def _gamepad(folder: Path) -> None:
    (folder / "pad.yaml").write_text("speed: right_y\nsteer: left_x\ndeadman: [right_shoulder]\ninverted: [speed]\n")


def _profile(folder: Path) -> None:
    (folder / "h.profile.yaml").write_text("points: [[0.0, 0.0], [1.0, 0.1], [2.0, 0.0]]\n")


def _heights(folder: Path) -> None:
    Image.fromarray(np.arange(900, dtype=np.uint16).reshape(30, 30)).save(folder / "h.png")


def _read_heights(folder: Path) -> None:
    _pictured(HeightImage(file=folder / "h.png", resolution=0.1, height=0.3))


def _mjcf(folder: Path) -> None:
    text = '<mujoco><compiler angle="degree"/><asset><texture name="t" type="2d" file="t.png"/></asset><worldbody>'
    text += '<geom type="box" size="1 1 1" euler="0 0 30"/><body pos="0 0 1"><geom size=".1"/></body></worldbody>'
    (folder / "s.xml").write_text(text + "</mujoco>")


def _certificate(folder: Path) -> None:
    certificates.new_authority("club", 1_700_000_000, 300).save(folder / "c.pem", folder / "k.pem")


def _calibration(folder: Path) -> None:
    from benchmarks.durability_parts.state import _result  # noqa: PLC0415

    CalibrationStore(folder, "truck").save(_result(3), 1_700_000_000 * 10**9)


def _read_calibration(folder: Path) -> None:
    CalibrationStore(folder, "truck").current()


def _stand(folder: Path) -> None:
    (folder / "stand.json").write_text(stand.StandCalibration(cameras={}, overlap_rms=None).model_dump_json())


def _odometer(folder: Path) -> None:
    (folder / "odometer.json").write_text(json.dumps({"metres": 12.5}))


def _read_checked(folder: Path) -> None:
    """Replay a truncated log: it differs."""
    command("replay", "--check", folder / "log.mcap", allowed=Reason.REPLAY_DIFFERS)


def _read_planned(folder: Path) -> None:
    command(
        "plan", folder / "m.yaml", "--budget", "0.05", "--", "-0.5,-1.5,0", "-0.4,-1.2,0", allowed=Reason.ROUTE_TIMEOUT
    )


def _localised(folder: Path) -> None:
    _saved(folder)
    _npz(folder)


def _read_localised(folder: Path) -> None:
    command("map", "localise", folder / "log.npz", folder / "map")


def _study(folder: Path) -> None:
    """Record fifteen seconds on a circle under a stand, with odometry."""
    config = load_truck(CONFIGS / "truck.yaml")[0].model_dump(mode="json")
    log = LogFile(folder / "log.mcap", Compression.LZ4, 1 << 16, {"config": config}, {}, SECOND)
    for seq in range(150):
        now = SECOND + seq * SECOND // 10
        stamps: dict[str, Any] = {"stamp": now, "received": now, "seq": seq}
        angle = 0.01 * seq
        pose = Pose2D(x=0.2 * math.sin(angle), y=-0.2 * math.cos(angle), yaw=angle)
        messages: dict[Topic[Any], Message] = {
            REQ_DRIVE: DriveRequest(
                **stamps, source="study", role=Role.STATION, lease=0.25, nonce="n", speed=0.0, front=0.0,
                shafts=(0.75, 1.5),
            ),
            STAND_POSE: StandPose(
                **stamps, frame="stand", pose=pose, observer="simulator", position_sigma=0.001, heading_sigma=0.01
            ),
            ODOMETRY: Odometry(
                **stamps, frame="odom", pose=pose, twist=Twist2D(vx=0.02, vy=0.0, wz=0.1), age=0.0,
                pose_covariance=np.zeros(9), twist_covariance=np.zeros(9),
            ),
        }  # fmt: skip
        for topic, message in messages.items():
            log.add(LogEntry(topic, now, now, seq, wire.encode(topic, message)))
    log.finish()


def _read_study(folder: Path) -> None:
    command("stand", "analyse", folder / "log.mcap")
    command("study", "analyse", folder / "log.mcap")


def _folder(folder: Path) -> None:
    """Write a finished log, and one of a killed daemon."""
    for finished in (True, False):
        made(folder, Compression.ZSTD, finished=finished)


def _read_folder(folder: Path) -> None:
    command("log", "list", folder)
    recover_directory(folder)
    command("log", "list", folder)


_LEG: Final = DrillLeg({}, 1, 0, 2)
_OUTCOMES: Final = TypeAdapter(list[dict[str, float]])


def _drill(folder: Path) -> None:
    LegFile(folder / "drill.jsonl", _LEG, _OUTCOMES).add(_LEG, [{"seconds": 0.5}, {"seconds": 1.5}])


def _read_drill(folder: Path) -> None:
    LegFile(folder / "drill.jsonl", _LEG, _OUTCOMES)


def _old(folder: Path) -> None:
    shutil.copy(DATA / "golden" / "0.1.0" / "truck.yaml", folder)


def _with_port(folder: Path) -> None:
    _old(folder)
    migrate.carry_out(migrate.plan(folder / "truck.yaml"))
    for kept in folder.glob("*.v*"):
        kept.unlink()


def _read_with_port(folder: Path) -> None:
    write_port(folder / "truck.yaml", "lidar", UsbPortConfig(hub="1-3", port=2))


def _read_robot_tls(folder: Path) -> None:
    """Open the robot's session as the daemon does, with the certificates of its folder."""
    tls = Folder(folder / "security").zenoh().tls
    assert tls is not None
    place = folder / "security" / "robot"
    there = {name: place / getattr(tls, name).name for name in ("ca", "certificate", "key")}
    endpoint = free_endpoint().replace("tcp/", "tls/", 1)
    clock = WallClock()
    config = ZenohConfig(listen=(endpoint,), local_socket=False, tls=tls.model_copy(update=there))

    async def session() -> None:
        bridge = ZenohBridge("truck", Bus(clock), config, clock, Rpc(clock))
        await bridge.open()
        await bridge.close()

    asyncio.run(session())


def _station(folder: Path) -> None:
    _stations(folder)
    (folder / "security" / "stations" / "station").rename(folder / "tls")
    shutil.rmtree(folder / "security")


def _read_station_tls(folder: Path) -> None:
    (folder / "tls" / "station.key").chmod(0o600)
    station_tls({TLS_VARIABLE: str(folder / "tls")}).owner()


def _read_authority(folder: Path) -> None:
    Folder(folder / "security").certificates(1_700_000_000)
    command("security", "rules", "--folder", folder / "security")
    certified = Folder(folder / "security")
    certified.add("another", None, None, 1_700_000_000)
    certified.revoke("another")


def _read_uploaded(folder: Path) -> None:
    read_mission((folder / "m.yaml").read_bytes().decode(errors="replace"))


def _stand_config(folder: Path) -> None:
    shutil.copy(CONFIGS / "stands" / "overhead.yaml", folder / "stand.yaml")


def _stand_pictures(folder: Path) -> None:
    shades = np.arange(4800, dtype=np.uint32).reshape(60, 80) // 20
    for name in ("a.png", "b.jpg", "c.pgm"):
        Image.fromarray(shades.astype(np.uint8)).save(folder / name)


def _film(folder: Path) -> None:
    film = cv2.VideoWriter(str(folder / "film.avi"), cv2.VideoWriter.fourcc(*"MJPG"), 10.0, (80, 60))
    for shade in range(0, 200, 40):
        film.write(np.full((60, 80, 3), shade, np.uint8))
    film.release()


def _read_film(folder: Path) -> None:
    for _ in stream(FileSource(path=folder / "film.avi"), (80, 60), 10.0):
        pass
