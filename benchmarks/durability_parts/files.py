"""Files that users hand in, mutated: each is read or refused, within 5 s and 500 MB, without a traceback of a library.

A kind is one or more sound files and the function that reads them. Mutations know no format (flips, holes, cuts,
blocks twice, noise) or a little of it (numbers, words and lines replaced), so that some pass the first checks.
"""

import gzip
import json
import logging
import random
import re
import shutil
import subprocess
import sys
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Callable
from contextlib import AbstractContextManager
from functools import cache
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
from PIL import Image

from benchmarks.durability_parts import maps
from benchmarks.durability_parts.damage import made
from benchmarks.durability_parts.state import missions
from monstertruck_drivers.hokuyo_urg.recording import RecordedRanges
from monstertruck_estimation.ground.grid import GroundGrid
from monstertruck_estimation.points import files as points
from monstertruck_estimation.slam import storage
from monstertruck_estimation.slam.storage import surface_elements
from monstertruck_planners.missions.progress import MissionProgress, SavedProgress
from monstertruck_planners.track.paths import load_path
from monstertruck_runtime.clock import WallClock
from monstertruck_runtime.errors import TruckError
from monstertruck_runtime.map_files import load_map
from monstertruck_schemas.mission import Mission
from monstertruck_schemas.roles import AccessRole
from monstertruck_sim.world.config import HeightImage
from monstertruck_sim.world.terrain import load_profile
from monstertruck_sim.world3d.ground import _pictured, scenery
from monstertruckd.config.calibration import CalibrationStore
from monstertruckd.config.expiry import DistanceCounter
from monstertruckd.config.load import SavedSettings, Tree, load_config, load_truck
from monstertruckd.config.start import started
from monstertruckd.recorder.config import Compression
from monstertruckd.recorder.reader import open_log
from monstertruckd.recorder.repair import recover
from monstertruckd.station.replay import ReplayFeed
from monstertruckd.station.users import StationUsers, add_user
from monstertruckd.tools.cli import logs as cli_logs
from monstertruckd.tools.cli.kinematics import _read_trajectory, _read_wheels
from monstertruckd.tools.demo.runs import free_endpoint
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

SECONDS: Final = 5.0
MEGABYTES: Final = 500.0
SHOWN: Final = 30
"""Faults that are printed, one of each kind and place."""
WORDS: Final = (b"-1", b"0", b"1e999", b"nan", b"null", b"[]", b"{}", b"''", b"true", b"4294967296", b"1e-320", b"\xff")
"""What numbers and words are replaced by."""
RUN: Final = 1.0
"""Seconds of the log of a drive."""
AT_ONCE: Final = 1e12
"""Speed of a replay that waits for no message."""
DATA: Final = Path(__file__).parents[2] / "tests" / "data"
CONFIGS: Final = Path(__file__).parents[2] / "configs"


class Kind(NamedTuple):
    """Files of one kind.

    Args:
        make: writes sound ones into an empty folder; the mutated ones are among them.
        read: reads the folder as a command or the daemon does.
        share: how often it is tried, in relation to others.
    """

    make: Callable[[Path], object]
    read: Callable[[Path], object]
    share: int = 2


def kinds() -> dict[str, Kind]:
    """By name."""
    return {
        "map": Kind(_map, lambda it: surface_elements(load_map(it / "m.yaml")), 4),
        "map16": Kind(_map16, lambda it: load_map(it / "m.yaml")),
        "saved map": Kind(_saved, _read_saved, 4),
        "log": Kind(_log, _read_log, 3),
        "log of a run": Kind(_run, _read_run, 1),
        "log replayed": Kind(_run, _read_replayed, 1),
        "log on the page": Kind(_run, _read_page, 1),
        "log viewed": Kind(_run, _read_viewed, 1),
        "log animated": Kind(_run, _read_animated, 1),
        "log as CSV": Kind(_run, _exported(lambda it: export_csv(it / "log.mcap", it / "csv")), 1),
        "log as npz": Kind(_run, _exported(lambda it: export_npz(it / "log.mcap", it / "npz")), 1),
        "log as MCAP": Kind(_run, _exported(lambda it: export_mcap(it / "log.mcap", it / "dated.mcap")), 1),
        "log as ROS 2 bag": Kind(_run, _exported(lambda it: export_ros2(it / "log.mcap", it / "bag")), 1),
        "scans npz": Kind(_npz, lambda it: read_scans(it / "log.npz"), 3),
        "scans CARMEN": Kind(_carmen, lambda it: read_scans(it / "log.log")),
        "scans CARMEN, packed": Kind(_carmen_packed, lambda it: read_scans(it / "log.gz")),
        "scans URG": Kind(_urg, lambda it: (read_scans(it / "log.dat"), RecordedRanges.load(it / "log.dat"))),
        "path": Kind(_path, lambda it: load_path(it / "p.csv", closed=False), 3),
        "trajectory": Kind(_trajectory, lambda it: _read_trajectory(it / "t.csv")),
        "wheels": Kind(_wheels, lambda it: _read_wheels(it / "w.yaml")),
        "mission": Kind(_mission, lambda it: load_config(it / "m.yaml", Mission), 3),
        "configuration": Kind(_config, lambda it: load_truck(it / "truck.yaml"), 1),
        "live settings": Kind(_settings, _read_settings, 3),
        "saved mission": Kind(_progress, _read_progress),
        "users": Kind(_users, _read_users),
        "gamepad": Kind(_gamepad, lambda it: read_mapping(it / "pad.yaml")),
        "profile": Kind(_profile, lambda it: load_profile(it / "h.profile.yaml")),
        "height picture": Kind(_heights, _read_heights),
        "mjcf": Kind(_mjcf, lambda it: scenery(it / "s.xml"), 3),
        "stations": Kind(_stations, lambda it: Folder(it / "security").register()),
        "certificate": Kind(_certificate, lambda it: certificates.load(it / "c.pem", it / "k.pem"), 3),
        "calibration": Kind(_calibration, _read_calibration, 3),
        "stand": Kind(_stand, lambda it: stand.load(it / "stand.json")),
        "odometer": Kind(_odometer, lambda it: DistanceCounter(it / "odometer.json").load()),
    }


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
    """First second of a drive, with all topics."""
    export_mcap(max(DATA.glob("golden/*/run.mcap")), folder / "log.mcap", Selection(end=RUN))


def _read_run(folder: Path) -> None:
    info(folder / "log.mcap")
    read_scans(folder / "log.mcap")
    with as_a_command(folder / "log.mcap"):
        collect(folder / "log.mcap")


def as_a_command(log: Path) -> AbstractContextManager[object]:
    """Context in which every command on logs reads one."""
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
    """Return what exports the log of a folder as the command does."""

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
    progress = SavedProgress.of(MissionProgress(mission, (0.0, 0.0, 0.0), 1), "ann")
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


# Mutations


def mutated(data: bytes, rng: random.Random) -> bytes:
    """One to three changes."""
    for _ in range(rng.randint(1, 3)):
        if not data:
            return data
        begin = rng.randrange(len(data))
        end = min(begin + int(2 ** rng.uniform(0, 12)), len(data))
        block, at = data[begin:end], rng.randrange(len(data))
        match rng.randrange(10):
            case 0 | 1:
                data = data[:begin] + bytes([data[begin] ^ 1 << rng.randrange(8)]) + data[begin + 1 :]
            case 2:
                data = data[:begin] + bytes(len(block)) + data[end:]
            case 3:
                data = data[:end]
            case 4:
                data = data[:at] + block + data[at:]
            case 5:
                data = data[:begin] + rng.randbytes(len(block)) + data[end:]
            case 6:
                data = data[:begin] + data[end:]
            case 7:
                data = data[:begin] + rng.choice((b"\xff\xff\xff\x7f", b"\0\0\0\x80", b"\xff" * 8)) + data[begin + 4 :]
            case _:
                data = _reworded(data, rng)
    return data


def _reworded(data: bytes, rng: random.Random) -> bytes:
    """A number or word replaced."""
    words = list(re.finditer(rb"-?[\w.]+", data[:20_000]))
    if not words:
        return data
    word = rng.choice(words)
    other = rng.choice((*WORDS, rng.choice(words).group() + b"0" * rng.choice((0, 1, 20, 400))))
    return data[: word.start()] + other + data[word.end() :]


# Runs


def peak() -> float:
    """Greatest memory of this process since it was last reset (MB)."""
    return int(Path("/proc/self/status").read_text(encoding="ascii").split("VmHWM:")[1].split()[0]) / 1000


def reset_peak() -> None:
    """Let ``peak`` begin anew."""
    Path("/proc/self/clear_refs").write_text("5", encoding="ascii")


def run(count: int, seed: int, work: Path) -> dict[str, Any]:
    """Mutate and read ``count`` files; figures by kind."""
    known = kinds()
    rng, tried = random.Random(seed), Counter[str]()
    figures = {name: {"files": 0, "read": 0, "faults": 0, "seconds": 0.0, "megabytes": 0.0} for name in known}
    names, shares = list(known), [kind.share for kind in known.values()]
    seen: set[str] = set()
    warnings.simplefilter("ignore")
    logging.disable()
    sound: dict[str, dict[str, bytes]] = {}
    for number in range(count):
        name = rng.choices(names, shares)[0]
        kind, row = known[name], figures[name]
        folder = work / ("f" * (1 + number % 2))
        key = f"{name} {number % 2}"
        folder.mkdir(parents=True)
        if key not in sound:
            kind.make(folder)
            files = (file for file in folder.rglob("*") if file.is_file() and not file.is_symlink())
            sound[key] = {str(file.relative_to(folder)): file.read_bytes() for file in files}
            kind.read(folder)
            shutil.rmtree(folder)
            folder.mkdir()
        for place, data in sound[key].items():
            (folder / place).parent.mkdir(parents=True, exist_ok=True)
            (folder / place).write_bytes(data)
        victim = folder / rng.choice(list(sound[key]))
        victim.write_bytes(mutated(victim.read_bytes(), rng))
        fault, seconds, megabytes = _try(kind, folder)
        tried[name] += 1
        row["files"] += 1
        row["read"] += fault is None
        row["seconds"], row["megabytes"] = max(row["seconds"], seconds), max(row["megabytes"], megabytes)
        if seconds > SECONDS or megabytes > MEGABYTES:
            fault = f"{seconds:.1f} s, {megabytes:.0f} MB"
        if fault:
            row["faults"] += 1
            if fault not in seen and len(seen) < SHOWN:
                seen.add(fault)
                print(f"{name}, file {number} ({victim.name}): {fault}", file=sys.stderr)
        shutil.rmtree(folder)
    return {name: {key: round(value, 2) for key, value in row.items()} for name, row in figures.items()}


def _try(kind: Kind, folder: Path) -> tuple[str | None, float, float]:
    """What a library raised ("" = a refusal of ours, None = it was read), seconds, and greatest memory (MB)."""
    reset_peak()
    begin, fault = time.perf_counter(), None
    try:
        kind.read(folder)
    except TruckError:
        fault = ""
    except Exception as error:  # noqa: BLE001 - whatever comes is a finding
        last = traceback.extract_tb(error.__traceback__)
        ours = [frame for frame in last if "site-packages" not in frame.filename][-1]
        fault = f"{type(error).__name__}: {str(error)[:120]} at {ours.filename[-50:]}:{ours.lineno}"
    return fault, time.perf_counter() - begin, peak()


def run_apart(count: int, seed: int, work: Path) -> dict[str, Any]:
    """``run`` in a process of its own: one that a library kills is a fault as well."""
    command = [sys.executable, "-m", "benchmarks.durability_parts.files", str(count), str(seed), str(work)]
    done = subprocess.run(command, stdout=subprocess.PIPE, check=False)
    shutil.rmtree(work, ignore_errors=True)
    if done.returncode:
        return {"all": {"files": 0, "faults": 1, "status": done.returncode}}
    figures: dict[str, Any] = json.loads(done.stdout)
    return figures


if __name__ == "__main__":
    print(json.dumps(run(int(sys.argv[1]), int(sys.argv[2]), Path(sys.argv[3]))))
