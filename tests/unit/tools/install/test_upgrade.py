"""Upgrading: refused while armed, and what ran before runs again if the new version does not become ready."""

from collections.abc import Sequence
from pathlib import Path

import pytest

from monstertruck_runtime.errors import BusyError, CommandFailedError, InputError, NotFoundError
from monstertruckd.tools.install import apply
from monstertruckd.tools.install.apply import install
from monstertruckd.tools.install.files import Program
from monstertruckd.tools.install.plan import AFTER_INSTALL, RESTART, UNIT
from monstertruckd.tools.install.upgrade import STATUS, upgrade
from tests.unit.tools.install.kit import PROGRAM, TRUCK, truck_plan

NEXT = Program(Path("/opt/next/.venv/bin/python"), Path("/opt/next/systemd/neutral.py"), (Path("/opt"),))


class Computer:
    """Makes a folder stand for this system with the service installed.

    Args:
        folder: its root.
        status: what systemd last got from the daemon, one line for each time it is asked; the last one stays.
        fails: programs of which a restart fails, by a part of the unit.
    """

    def __init__(self, folder: Path, status: Sequence[str] = ("disarmed",), fails: Sequence[str] = ()) -> None:
        self.folder = folder
        self.status = list(status)
        self.active = "active"
        self.fails = fails
        self.ran: list[tuple[str, ...]] = []
        self.interrupted = False

    def __call__(self, arguments: Sequence[str]) -> str:
        command = tuple(arguments)
        if command == STATUS:
            line = self.status.pop(0) if len(self.status) > 1 else self.status[0]
            return f"ActiveState={self.active}\nStatusText={line}\n"
        self.ran.append(command)
        if command == RESTART and any(part in self.unit for part in self.fails):
            if self.interrupted:
                raise KeyboardInterrupt
            raise CommandFailedError("systemctl: Job for monstertruckd.service failed")
        return ""

    @property
    def unit(self) -> str:
        return self.file(str(UNIT)).read_text()

    def file(self, path: str) -> Path:
        return self.folder / path.removeprefix("/")

    def upgrade(self, program: Program = NEXT, config: Path | None = None) -> apply.InstallReport:
        return upgrade(truck_plan(Path("/"), config, program), Path("/"), run=self)


@pytest.fixture
def computer(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Computer:
    here = Computer(tmp_path)
    monkeypatch.setattr(
        apply, "below", lambda root, path: (root if root != Path("/") else tmp_path) / path.relative_to("/")
    )
    (tmp_path / "run/systemd/system").mkdir(parents=True)
    install(truck_plan(Path("/"), TRUCK, PROGRAM), Path("/"), run=here)
    here.ran.clear()
    return here


def test_the_new_version_is_installed_and_restarted(computer: Computer):
    report = computer.upgrade(config=TRUCK)
    assert report.commands == [*AFTER_INSTALL, RESTART] == computer.ran
    assert "ExecStart=/opt/next/.venv/bin/python" in computer.unit


@pytest.mark.parametrize("mode", ["armed", "driving", "stopping", "driving; not ready: camera (waiting)"])
def test_an_armed_truck_is_not_upgraded(mode: str, computer: Computer):
    before = computer.unit
    computer.status = [mode]
    with pytest.raises(BusyError, match="disarm it first"):
        computer.upgrade(config=TRUCK)
    assert computer.unit == before
    assert computer.ran == []


@pytest.mark.parametrize(("state", "mode"), [("active", "estopped"), ("activating", "driving"), ("failed", "")])
def test_what_stands_or_does_not_run_is_upgraded(state: str, mode: str, computer: Computer):
    computer.active, computer.status = state, [mode]
    assert RESTART in computer.upgrade(config=TRUCK).commands


def test_a_truck_armed_while_files_were_written_is_not_restarted(computer: Computer):
    before = computer.unit
    computer.status = ["disarmed", "armed"]
    with pytest.raises(BusyError, match="the robot is armed"):
        computer.upgrade(config=TRUCK)
    assert computer.unit == before
    assert computer.ran == [*AFTER_INSTALL, *AFTER_INSTALL]


@pytest.mark.parametrize("interrupted", [False, True])
def test_without_ready_the_version_before_runs_again(interrupted: bool, computer: Computer, tmp_path: Path):
    config = tmp_path / "new.yaml"
    config.write_text(f"include: {TRUCK}\n")
    before = {path: path.read_text() for path in computer.file("/etc").rglob("*") if path.is_file()}
    computer.fails, computer.interrupted = ["/opt/next"], interrupted
    with pytest.raises(CommandFailedError, match="the previous version runs again"):
        computer.upgrade(config=config)
    assert computer.ran == [*AFTER_INSTALL, RESTART, *AFTER_INSTALL, RESTART]
    assert {path: path.read_text() for path in before} == before
    assert not computer.file("/etc/monstertruckd/new.yaml").exists()


def test_it_says_so_when_neither_version_runs(computer: Computer):
    computer.fails = ["/opt"]
    with pytest.raises(CommandFailedError, match="the previous version does not run either: systemctl: Job"):
        computer.upgrade(config=TRUCK)


def test_a_version_in_the_same_folder_has_none_to_go_back_to(computer: Computer):
    computer.fails = ["/opt"]
    with pytest.raises(CommandFailedError, match="the previous one was in the same folder"):
        computer.upgrade(PROGRAM, TRUCK)
    assert computer.ran == [RESTART]


def test_a_dry_run_is_refused_alike_and_changes_nothing(computer: Computer):
    before = computer.unit
    report = upgrade(truck_plan(Path("/"), TRUCK, NEXT), Path("/"), dry=True, run=computer)
    assert report.commands == [*AFTER_INSTALL, RESTART]
    assert (computer.unit, computer.ran) == (before, [])
    computer.status = ["armed"]
    with pytest.raises(BusyError):
        upgrade(truck_plan(Path("/"), TRUCK, NEXT), Path("/"), dry=True, run=computer)


def test_there_must_be_a_service_of_a_system_that_runs(computer: Computer, tmp_path: Path):
    with pytest.raises(InputError, match="systemd does not run there"):
        upgrade(truck_plan(tmp_path / "image", TRUCK, NEXT), tmp_path / "image", run=computer)
    computer.file(str(UNIT)).unlink()
    with pytest.raises(NotFoundError, match="no service is installed"):
        computer.upgrade(config=TRUCK)
