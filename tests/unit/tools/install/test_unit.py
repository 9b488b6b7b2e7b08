"""The unit: its promises in its own text, and what systemd itself says to it where there is one."""

import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from monstertruck_runtime.errors import InputError
from monstertruck_runtime.yaml_files import yaml_text
from monstertruckd.config.load import load_truck
from monstertruckd.tools.install.files import Program, filled, unit_text
from monstertruckd.tools.install.plan import plan
from tests.unit.tools.install.kit import PROGRAM, ROOT, TRUCK, settings, text_of, truck_plan

ANALYZE = shutil.which("systemd-analyze")
CONFIG = Path("/etc/monstertruckd/truck.yaml")


def unit_of(config: Path = TRUCK, program: Program = PROGRAM, user: str = "monstertruckd") -> str:
    return unit_text(load_truck(config)[0], CONFIG, user, program)


def overlay(folder: Path, **values: object) -> Path:
    file = folder / "truck.yaml"
    file.write_text(yaml_text({"include": str(TRUCK), "version": 1, **values}))
    return file


def test_a_daemon_that_hangs_or_dies_is_replaced_and_the_drive_stopped():
    unit = settings(unit_of())
    assert unit["Type"] == ["notify"]
    assert unit["WatchdogSec"] == ["3"]
    assert unit["TimeoutAbortSec"] == ["1"], "a frozen process takes no SIGABRT"
    assert unit["TimeoutStartSec"] == ["30"], "the watchdog counts from READY on only"
    assert unit["TimeoutStopSec"] == ["30"], "black box and recorder finish on a slow board"
    assert unit["Restart"] == ["always"]
    assert "RestartPreventExitStatus" not in unit, "a refusal may pass: an address or a disk that is not there yet"
    assert unit["RestartSec"] == ["1"]
    assert unit["StartLimitIntervalSec"] == ["0"]
    assert unit["ExecStart"] == [
        "/opt/monstertruckd/.venv/bin/python -P -m monstertruckd run --config /etc/monstertruckd/truck.yaml"
    ]
    assert unit["ExecStopPost"] == [
        "/opt/monstertruckd/.venv/bin/python -I -S /opt/monstertruckd/systemd/neutral.py /dev/truck/drive=1@38400"
    ]


def test_state_is_kept_where_it_may_be_written_and_numba_works():
    unit = settings(unit_of())
    assert unit["WorkingDirectory"] == [f"%S/{unit['StateDirectory'][0]}"]
    assert unit["RuntimeDirectoryPreserve"] == ["yes"], "the mark of an emergency stop outlasts a killed daemon"
    assert "NUMBA_CACHE_DIR=%C/monstertruckd/numba" in unit["Environment"]
    assert "monstertruckd/numba" in unit["CacheDirectory"][0].split()
    assert "MemoryDenyWriteExecute" not in unit
    assert "ProcSubset" not in unit


def test_only_the_trucks_kinds_of_devices_may_be_opened():
    unit = settings(unit_of())
    assert unit["DevicePolicy"] == ["closed"]
    kinds = ("ttyACM", "ttyUSB", "i2c", "video4linux", "media", "dma_heap")  # the last two are for rpicam-vid
    assert unit["DeviceAllow"] == [f"char-{kind} rw" for kind in kinds]
    assert unit["SupplementaryGroups"] == ["dialout i2c video"]
    assert filled("modules-load.conf", {}).splitlines()[1:] == ["cdc_acm", "i2c_dev", "usbserial", "videodev"]


def test_every_shaft_is_stopped(tmp_path: Path):
    file = tmp_path / "truck.yaml"
    file.write_text(
        "version: 1\nbody: {kind: differential}\ndevices:\n"
        "  drive: {port: {path: /dev/truck/drive, baud: 38400}, driver: {kind: epos}}\n"
        "  drive_2: {port: {hub: 1-1, port: 7, baud: 57600}, driver: {kind: epos, node: 3}}\n"
    )
    (stop,) = settings(unit_of(file))["ExecStopPost"]
    assert stop.endswith("neutral.py /dev/truck/drive=1@38400 /dev/truck/drive_2=3@57600")


def test_without_a_drive_nothing_is_stopped(tmp_path: Path):
    file = tmp_path / "truck.yaml"
    file.write_text("version: 1\ndevices:\n  lidar: {port: {hub: 1-1, port: 1}, driver: {kind: hokuyo_urg}}\n")
    assert "ExecStopPost" not in settings(unit_of(file))


def test_a_program_at_home_is_shown_to_the_service_and_nothing_else_of_it():
    home = Path("/home/pi/monstertruckd")
    program = Program(home / ".venv/bin/python", home / "systemd/neutral.py", (home, Path("/usr")))
    unit = settings(unit_of(program=program))
    assert unit["ProtectHome"] == ["tmpfs"]
    assert unit["BindReadOnlyPaths"] == [str(home)]
    assert settings(unit_of())["ProtectHome"] == ["yes"]
    assert "BindReadOnlyPaths" not in settings(unit_of())


@pytest.mark.parametrize("place", ["/tmp/truck", "/var/tmp/x"])
def test_a_temporary_program_is_refused_where_it_would_run_and_pointed_out_elsewhere(place: str, tmp_path: Path):
    program = Program(PROGRAM.python, PROGRAM.neutral, (Path(place),))
    with pytest.raises(InputError, match=f"{place}: temporary"):
        truck_plan(Path("/"), program=program)
    assert truck_plan(tmp_path, program=program).notes[-1].startswith(f"{place}: temporary")


def test_a_path_systemd_would_split_is_refused():
    with pytest.raises(InputError, match="/opt/my truck/python: expected an absolute path"):
        unit_of(program=Program(Path("/opt/my truck/python"), PROGRAM.neutral, ()))


@pytest.mark.parametrize(
    "user",
    [
        "x\nExecStartPre=/bin/sh",
        "x\n",
        "",
        "Truck",
        "1st",
        "a b",
        "%i",
        "-x",
        "x" * 33,
        "\N{LATIN SMALL LETTER E WITH ACUTE}",
    ],
)
def test_a_user_who_cannot_be_called_so_is_refused(user: str, tmp_path: Path):
    with pytest.raises(InputError, match="expected a lower-case letter"):
        unit_of(user=user)
    with pytest.raises(InputError, match="expected a lower-case letter"):
        plan(TRUCK, user, PROGRAM, tmp_path)


@pytest.mark.parametrize("user", ["pi", "_truck-1", "x" * 32])
def test_users_names(user: str):
    assert settings(unit_of(user=user))["User"] == [user]


def test_paths_that_would_end_too_early_are_refused(tmp_path: Path):
    home = Path("/home/pi/a:b")
    with pytest.raises(InputError, match="/home/pi/a:b: expected a path without :"):
        unit_of(program=Program(PROGRAM.python, PROGRAM.neutral, (home,)))
    file = tmp_path / "truck.yaml"
    file.write_text("version: 1\ndevices: {drive: {port: {path: /dev/a=b}, driver: {kind: epos}}}\n")
    with pytest.raises(InputError, match="/dev/a=b: expected a path without ="):
        unit_of(file)


@pytest.mark.parametrize("sign", ["\n", " ", '"', "%", "$", "\\", ";", "@"])
def test_no_sign_of_a_path_means_anything_to_systemd(sign: str):
    with pytest.raises(InputError, match="expected an absolute path"):
        unit_of(program=Program(Path(f"/opt/a{sign}b"), PROGRAM.neutral, ()))


def test_ports_that_are_to_be_switched_can_be_written(tmp_path: Path):
    unit = settings(unit_of(overlay(tmp_path, usb={"power": {"method": "port"}})))
    assert unit["ReadWritePaths"] == ["-/sys/devices"]
    assert "ReadWritePaths" not in settings(unit_of())


def test_nothing_is_left_to_fill_in(tmp_path: Path):
    for file in truck_plan(tmp_path).files:
        assert not re.search(r"@[a-z]+@", file.text), file.path


def test_the_program_that_runs_now_is_whole():
    program = Program.present()
    assert program.python == Path(sys.executable)
    assert program.neutral == ROOT / "systemd" / "neutral.py"
    assert ROOT in program.reads
    assert Path(sys.base_prefix) in program.reads


@pytest.mark.skipif(ANALYZE is None, reason="no systemd here")
@pytest.mark.parametrize("home", [PROGRAM.reads[0], Path("/home/pi")])
def test_systemd_finds_nothing_wrong_and_little_exposed(home: Path, tmp_path: Path):
    there = Program(Path(sys.executable), PROGRAM.neutral, (home,))
    file = tmp_path / "monstertruckd.service"
    file.write_text(text_of(truck_plan(tmp_path, program=there), file.name))
    verified = _analyze("verify", str(file))
    assert verified == (0, "")
    code, said = _analyze("security", "--offline=true", "--threshold=16", "--no-pager", str(file))
    assert code == 0, said


def _analyze(*arguments: str) -> tuple[int, str]:
    assert ANALYZE is not None
    done = subprocess.run([ANALYZE, *arguments], capture_output=True, text=True, timeout=30, check=False)
    return done.returncode, done.stdout + done.stderr
