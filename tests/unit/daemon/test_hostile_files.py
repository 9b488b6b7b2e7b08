"""Every reader of files, with files that disks and other programs damaged: an error about the file, never a wait."""

import ast
import os
import random
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from types import FrameType, SimpleNamespace
from typing import cast

import numpy as np
import pytest

from monstertruck_estimation.ground.grid import GroundGrid
from monstertruck_estimation.points import files as points
from monstertruck_estimation.slam import storage
from monstertruck_planners.missions.service import MissionService
from monstertruck_planners.track.paths import load_path
from monstertruck_planners.zones import files as zones
from monstertruck_planners.zones.config import ZonesConfig
from monstertruck_runtime import map_folders
from monstertruck_runtime.errors import TruckError
from monstertruck_runtime.map_files import load_map
from monstertruck_runtime.small_files import replace_file, whole_file
from monstertruck_schemas.zones import ZoneArea
from monstertruckd.config.calibration import CalibrationStore
from monstertruckd.config.expiry import DistanceCounter
from monstertruckd.config.load import SavedSettings, load_config
from monstertruckd.config.proposal import SteeringProposal
from monstertruckd.config.truck import TruckConfig
from monstertruckd.gate.latch import EstopLatch
from monstertruckd.recorder.reader import open_log
from monstertruckd.station import users
from monstertruckd.tools.driving.gamepad import read_mapping
from monstertruckd.tools.logs.scans import read_scans
from monstertruckd.tools.security.certificates import read_certificates
from monstertruckd.tools.security.folder import Folder
from monstertruckd.tools.stand import calibration as stand
from monstertruckd.tools.urdf import load_urdf
from tests.unit.config.test_corrupt_calibration import saved

ROOT = Path(__file__).parents[3]
CONFIG = ROOT / "configs" / "demo.yaml"
STAIRS = ZoneArea(kind="keepout", corners=((0.0, 0.0), (1.0, 0.0), (1.0, 1.0)))
MAP = b"image: map.png\nresolution: 0.05\norigin: [0, 0, 0]\nnegate: 0\noccupied_thresh: 0.65\nfree_thresh: 0.25\n"


@dataclass(frozen=True)
class Reader:
    """One reader, and the content it expects."""

    name: str
    content: bytes
    read: Callable[[Path], object]
    """Reads the file; returns a text for a fault that it reports without an exception."""


def odometer(file: Path) -> str:
    return DistanceCounter(file).load()


def proposal(file: Path) -> str:
    return SteeringProposal(cast("TruckConfig", SimpleNamespace(chassis=lambda: None)), "", file).load()


def mission(file: Path) -> object:
    return MissionService._load(cast("MissionService", SimpleNamespace(_file=file)))


def private(file: Path) -> object:
    with suppress(OSError):
        file.chmod(0o600)
    return users._read(file)


def latched(file: Path) -> str:
    return "latched" if EstopLatch(file, file.parent).engaged() else ""


def log_damage(file: Path) -> str:
    log = open_log(file)
    list(log)
    return log.damage or ""


READERS = (
    Reader("zones.json", zones.ZoneFile(zones={"stairs": STAIRS}).model_dump_json().encode(), zones.load_saved),
    Reader("zones.yaml", b"zones: {}\n", lambda file: zones.configured(ZonesConfig(file=file), 1.0)),
    Reader("odometer.json", b'{"metres": 12.5}', odometer),
    Reader("proposal.json", b'{"base": "", "result": {"wizard": "steering", "measured": ""}}', proposal),
    Reader("mission.json", b'{"mission": {"name": "a", "steps": []}, "source": "x"}', mission),
    Reader("settings-truck.yaml", b"gate:\n  max_speed: 0.2\n", lambda f: SavedSettings(f.parent, "truck").values()),
    Reader("0001-2026-11-11T000000Z.json", b"", lambda file: CalibrationStore(file.parent, "truck").load(file)),
    Reader("users.yaml", f"a: {{role: driver, password: '{users.NO_HASH}'}}\n".encode(), private),
    Reader("register.yaml", b"robot: truck\n", lambda file: Folder(file.parent).register()),
    Reader("authority.pem", b"-----BEGIN CERTIFICATE-----\nMII=\n-----END CERTIFICATE-----\n", read_certificates),
    Reader("points.json", b"[]", lambda file: points.load(file.parent)),
    Reader("ground.npz", b"", lambda file: GroundGrid.load(file.parent)),
    Reader("graph.npz", b"", storage._read_graph),
    Reader("map.yaml", MAP, load_map),
    Reader(map_folders.MANIFEST, b'{"run": "a", "parts": {}}', lambda file: map_folders._check(file.parent)),
    Reader("truck.yaml", b"robot: truck\n", lambda file: load_config(file, TruckConfig)),
    Reader("pad.yaml", b"buttons: {}\n", read_mapping),
    Reader("path.csv", b"x,y\n0,0\n1,0\n2,0\n", partial(load_path, closed=False)),
    Reader("stand.json", b'{"cameras": {}}', stand.load),
    Reader("robot.urdf", b"<robot name='a'><link name='base_link'/></robot>", load_urdf),
    Reader("scans.log", b"FLASER 3 1.0 1.0 1.0 0 0 0 0 0 0 1.5 h 1.5\n" * 3, read_scans),
    Reader("scans.bag", b"#ROSBAG V2.0\n" + bytes(40), read_scans),
    Reader("log.mcap", (ROOT / "tests/data/zeros4k.mcap").read_bytes(), log_damage),
    Reader("estop", b"emergency stop latched\n", latched),
)


@contextmanager
def at_most(seconds: int) -> Iterator[None]:
    """Fail a body that waits, for example for the writer of a pipe."""

    def late(_signal: int, _frame: FrameType | None) -> None:
        pytest.fail(f"blocked for {seconds} s")

    before = signal.signal(signal.SIGALRM, late)
    signal.alarm(seconds)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)


def whole(reader: Reader, folder: Path) -> Path:
    """The intact file."""
    if reader.name.startswith("0001"):
        return saved(folder)
    file = folder / reader.name
    if reader.name.endswith(".npz"):
        np.savez_compressed(file, version=np.int64(2), corner=np.zeros(2), counts=np.ones((3, 3)))
    else:
        file.write_bytes(reader.content)
    return file


def refused(reader: Reader, file: Path) -> bool:
    """Whether the reader reports a fault; any exception of another class than ours is an error of the reader."""
    try:
        with at_most(10):
            return bool(isinstance(found := reader.read(file), str) and found)
    except TruckError:
        return True


PLACES: dict[str, Callable[[Path], object]] = {
    "a folder": lambda file: file.mkdir(),
    "a pipe": os.mkfifo,
    "a link to nothing": lambda file: file.symlink_to(file.with_name("absent")),
    "a link to itself": lambda file: file.symlink_to(file.name),
    "a device": lambda file: file.symlink_to("/dev/zero"),
}
"""What stands where the file should be."""


def nested(opening: bytes, closing: bytes, depth: int = 100_000) -> bytes:
    return opening * depth + closing * depth


CONTENTS: dict[str, bytes] = {
    "nothing": b"",
    "zeros": bytes(4096),
    "garbage": random.Random(1).randbytes(4096),
    "a list": b"[1, 2]",
    "a mapping": b'{"a": {"b": 1}}',
    "a number": b"1e400",
    "not a number": b"NaN",
    "null": b"null",
    "text": b'"text"',
    "a huge integer": b"9" * 5000,
    "duplicated keys": b'{"metres": 1, "metres": 2, "zones": {}, "zones": []}',
    "nested lists": nested(b"[", b"]"),
    "nested mappings": nested(b'{"a":', b"}"),
    "tabs": b"a:\n\tb: 1\n",
    "anchors": b"a: &a [1, 2]\nb: *a\n<<: {c: 1}\n",
    "an endless anchor": b"&a [*a]",
    "a bomb of anchors": b"a: &a [x,x,x,x,x,x,x,x,x]\n"
    + b"".join(b"%c: &%c [%s]\n" % (98 + i, 98 + i, b",".join([b"*%c" % (97 + i)] * 9)) for i in range(8)),
    "a tag": b"!!python/object/apply:os.system ['true']",
    "surrogates": b'{"a": "\\ud800"}',
    "entities": b'<!DOCTYPE a [<!ENTITY b "bbbb"><!ENTITY c "&b;&b;&b;">]><robot>&c;</robot>',
}


@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize("reader", READERS, ids=lambda reader: reader.name)
def test_what_is_no_file_is_refused_at_once(reader: Reader, place: str, tmp_path: Path):
    PLACES[place](tmp_path / reader.name)
    assert refused(reader, tmp_path / reader.name)


@pytest.mark.parametrize("reader", READERS, ids=lambda reader: reader.name)
def test_a_sparse_file_is_refused_or_streamed(reader: Reader, tmp_path: Path):
    (tmp_path / reader.name).touch()
    os.truncate(tmp_path / reader.name, 1 << (25 if reader.name.startswith(("log", "scans")) else 30))
    assert refused(reader, tmp_path / reader.name)


@pytest.mark.parametrize("reader", READERS, ids=lambda reader: reader.name)
def test_other_content_never_ends_a_reader_with_a_foreign_exception(reader: Reader, tmp_path: Path):
    file = tmp_path / reader.name
    for content in CONTENTS.values():
        file.write_bytes(content)
        refused(reader, file)


@pytest.mark.parametrize("reader", READERS, ids=lambda reader: reader.name)
def test_every_damage_of_the_own_content_is_handled(reader: Reader, tmp_path: Path):
    file = whole(reader, tmp_path)
    content, rng = file.read_bytes(), random.Random(2)
    text = content.decode("latin-1")
    damaged = [content[: len(content) * tenth // 10] for tenth in range(10)]
    damaged += [b"\xef\xbb\xbf" + content, text.encode("utf-16"), content.replace(b"\n", b"\r\n"), content * 2]
    for _ in range(40):
        flipped = bytearray(content)
        flipped[rng.randrange(len(content))] ^= 1 << rng.randrange(8)
        damaged.append(bytes(flipped))
    for bad in damaged:
        file.write_bytes(bad)
        refused(reader, file)


@pytest.mark.parametrize("place", PLACES)
def test_what_is_no_file_is_not_written_over(place: str, tmp_path: Path):
    file = tmp_path / "state.json"
    PLACES[place](file)
    before = file.lstat()
    with suppress(OSError), at_most(10):
        replace_file(file, "new")
    with suppress(OSError), at_most(10), whole_file(file) as part:
        part.write_text("new")
    assert file.lstat().st_mode == before.st_mode


GUARDS = {"require_file", "contents", "contents_if_present", "is_file"}
OWN_FILES = {
    "monstertruckd/bus/port_holder.py": "the kernel's table of sockets",
    "monstertruckd/ros2/interfaces.py": "a shipped file",
    "monstertruckd/station/server.py": "the shipped page",
    "monstertruckd/tools/cli/entry.py": "a shipped file",
    "monstertruckd/tools/drill/legs.py": "the program's own modules",
    "monstertruckd/tools/demo/runs.py": "files that the run has written",
    "monstertruckd/tools/install/files.py": "a shipped file",
    "monstertruckd/tools/install/plan.py": "files of a configuration that has been read",
    "monstertruckd/tools/install/upgrade.py": "an installed unit",
    "monstertruckd/tools/logs/report/page.py": "a shipped file",
    "monstertruckd/tools/new_driver/write.py": "a shipped template",
    "schemas/monstertruck_runtime/endpoints.py": "the kernel's table of sockets",
    "schemas/monstertruck_runtime/extras.py": "metadata of the installed package",
    "schemas/monstertruck_runtime/map_folders.py": "a file of a save that has been checked",
    "schemas/monstertruck_runtime/memory.py": "the kernel's table of memory",
    "schemas/monstertruck_runtime/open_files.py": "the kernel's table of processes",
    "schemas/monstertruck_runtime/small_files.py": "a file of the kernel",
    "drivers/monstertruck_drivers/battery/iio.py": "a file of the kernel",
    "drivers/monstertruck_drivers/computer.py": "a file of the kernel",
}
"""Files that may read without a guard, and what they read."""


def raw_reads() -> Iterator[tuple[str, str]]:
    """File and function of each read of a file that none of ``GUARDS`` protects."""
    for package in ("monstertruckd", "planners", "schemas", "drivers"):
        for file in sorted((ROOT / package).rglob("*.py")):
            for function in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
                if not isinstance(function, ast.FunctionDef | ast.AsyncFunctionDef):
                    continue
                calls = [ast.unparse(call.func) for call in ast.walk(function) if isinstance(call, ast.Call)]
                names = {call.rpartition(".")[2] for call in calls}
                raw = bool(names & {"read_text", "read_bytes"}) or bool({"np.load", "json.load", "open"} & {*calls})
                if raw and not names & GUARDS:
                    yield str(file.relative_to(ROOT)), function.name


def test_every_reader_uses_a_function_that_neither_blocks_nor_reads_without_limit():
    assert [(file, name) for file, name in raw_reads() if file not in OWN_FILES] == []


def test_the_list_of_exceptions_has_no_stale_row():
    assert {file for file, _ in raw_reads()} == OWN_FILES.keys()
