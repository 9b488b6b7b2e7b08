"""Installing and taking out: twice is once, nothing of the operator's is lost, the system is informed once."""

import os
import shutil
import subprocess
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from monstertruck_runtime.errors import CommandFailedError, ConfigError, NotFoundError, NotPermittedError
from monstertruck_runtime.map_files import WorldMap, load_map, map_content, save_map
from monstertruck_runtime.map_folders import write_save
from monstertruckd.config.load import load_truck
from monstertruckd.tools.install import apply
from monstertruckd.tools.install.apply import Change, InstallReport, install, run_command, uninstall
from monstertruckd.tools.install.plan import AFTER_INSTALL, AFTER_REMOVAL, BEFORE_REMOVAL
from tests.unit.tools.install.kit import ROOT, TRUCK, settings, truck_plan


def tree(root: Path) -> dict[str, str]:
    """Every file and link below ``root`` with what it says."""
    return {
        str(path.relative_to(root)): str(path.readlink()) if path.is_symlink() else path.read_text()
        for path in sorted(root.rglob("*"))
        if path.is_symlink() or path.is_file()
    }


CONFIGURATION = (
    "etc/monstertruckd/parts/chassis.yaml",
    "etc/monstertruckd/parts/equipment.yaml",
    "etc/monstertruckd/parts/first_day.yaml",
    "etc/monstertruckd/parts/navigation.yaml",
    "etc/monstertruckd/truck.yaml",
)


def test_everything_is_where_systemd_and_udev_look(tmp_path: Path):
    report = install(truck_plan(tmp_path), tmp_path)
    assert set(report.changes.values()) == {Change.NEW}
    assert report.commands == [], "a system elsewhere is only written"
    assert list(tree(tmp_path)) == [
        "etc/modules-load.d/monstertruckd.conf",
        *CONFIGURATION,
        "etc/systemd/system/monstertruckd.service",
        "etc/systemd/system/multi-user.target.wants/monstertruckd.service",
        "etc/sysusers.d/monstertruckd.conf",
        "etc/tmpfiles.d/monstertruckd.conf",
        "etc/udev/rules.d/70-monstertruckd.rules",
    ]
    assert tree(tmp_path)["etc/monstertruckd/truck.yaml"] == TRUCK.read_text()
    assert (tmp_path / "etc/systemd/system/monstertruckd.service").stat().st_mode & 0o777 == 0o644


@pytest.mark.parametrize("config", [TRUCK, None], ids=["the same", "the installed"])
def test_the_second_time_nothing_changes(config: Path | None, tmp_path: Path):
    install(truck_plan(tmp_path), tmp_path)
    before = tree(tmp_path)
    report = install(truck_plan(tmp_path, config), tmp_path)
    assert not report.changed
    assert tree(tmp_path) == before


def test_the_user_of_the_installed_unit_stays_until_another_is_named(tmp_path: Path):
    unit = tmp_path / "etc/systemd/system/monstertruckd.service"
    for user, found in ((None, "monstertruckd"), ("pi", "pi"), (None, "pi"), ("truck", "truck")):
        install(truck_plan(tmp_path, user=user), tmp_path)
        assert settings(unit.read_text())["User"] == [found]


def test_the_second_time_the_configuration_may_have_any_name(tmp_path: Path):
    mine = tmp_path / "mine.yaml"
    mine.write_text(f"version: 1\ninclude: {TRUCK}\n")
    root = tmp_path / "root"
    install(truck_plan(root, mine), root)
    assert not install(truck_plan(root, None), root).changed
    (root / "etc/monstertruckd/truck.yaml").write_text("not the one\n")
    assert not install(truck_plan(root, None), root).changed

    (root / "etc/monstertruckd/mine.yaml").unlink()
    with pytest.raises(NotFoundError, match=r"etc/monstertruckd/mine.yaml: no configuration is installed"):
        truck_plan(root, None)


def test_an_edited_configuration_is_kept_as_well_and_its_change_reaches_the_rules(tmp_path: Path):
    install(truck_plan(tmp_path), tmp_path)
    installed = tmp_path / "etc/monstertruckd/truck.yaml"
    edited = installed.read_text().replace('hub: "1-2", port: 1', 'hub: "1-2", port: 4')
    installed.write_text(edited)
    report = install(truck_plan(tmp_path, None), tmp_path)
    changed = [path.name for path, change in report.changes.items() if change is not Change.SAME]
    assert changed == ["70-monstertruckd.rules"]
    assert 'KERNELS=="1-2.4:*.0"' in (tmp_path / "etc/udev/rules.d/70-monstertruckd.rules").read_text()
    assert installed.read_text() == edited

    report = install(truck_plan(tmp_path, TRUCK), tmp_path)
    assert report.previous == [Path("/etc/monstertruckd/truck.yaml~")]
    assert (tmp_path / "etc/monstertruckd/truck.yaml~").read_text() == edited
    assert installed.read_text() == TRUCK.read_text()


def test_a_dry_run_tells_the_same_and_does_nothing(tmp_path: Path):
    said = install(truck_plan(tmp_path), tmp_path, dry=True)
    assert tree(tmp_path) == {}
    assert install(truck_plan(tmp_path), tmp_path) == said
    before = tree(tmp_path)
    said = uninstall(tmp_path, dry=True)
    assert tree(tmp_path) == before
    assert uninstall(tmp_path) == said


def test_taking_out_leaves_the_configuration_and_may_be_repeated(tmp_path: Path):
    install(truck_plan(tmp_path), tmp_path)
    report = uninstall(tmp_path)
    assert set(report.changes.values()) == {Change.REMOVED}
    assert tuple(tree(tmp_path)) == CONFIGURATION
    assert not uninstall(tmp_path).changed


class Here:
    """Makes a folder stand for this system, and keeps the programs that were run; ``fails`` is the one that fails."""

    def __init__(self, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        self.ran: list[tuple[str, ...]] = []
        self.fails: str | None = None
        monkeypatch.setattr(apply, "below", lambda _, path: folder / path.relative_to("/"))
        (folder / "run/systemd/system").mkdir(parents=True)

    def __call__(self, arguments: Sequence[str]) -> None:
        self.ran.append(tuple(arguments))
        if self.fails is not None and self.fails in arguments:
            raise CommandFailedError(f"{arguments[0]}: no")

    def install(self) -> InstallReport:
        return install(truck_plan(Path("/")), Path("/"), run=self)


def test_the_running_system_is_informed_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    here = Here(tmp_path, monkeypatch)
    assert here.install().commands == list(AFTER_INSTALL)
    assert here.ran == list(AFTER_INSTALL)
    assert not here.install().changed
    assert here.ran == list(AFTER_INSTALL)
    here.ran.clear()
    assert uninstall(Path("/"), run=here).changed
    assert here.ran == [*BEFORE_REMOVAL, *AFTER_REMOVAL]


def test_a_system_that_does_not_run_is_only_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    here = Here(tmp_path, monkeypatch)
    (tmp_path / "run/systemd/system").rmdir()
    assert here.install().commands == []
    assert uninstall(Path("/"), run=here).changed
    assert here.ran == []


def test_an_installation_that_broke_off_goes_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    here = Here(tmp_path, monkeypatch)
    here.fails = "systemd-tmpfiles"
    with pytest.raises(CommandFailedError):
        here.install()
    here.fails = None
    here.ran.clear()
    assert here.install().changed
    assert here.ran == list(AFTER_INSTALL), "the files are all there, but they were not reported"
    assert not here.install().changed


def test_nothing_is_run_by_a_shell_or_over_the_network():
    programs = {command[0] for command in (*AFTER_INSTALL, *BEFORE_REMOVAL, *AFTER_REMOVAL)}
    assert programs == {"systemctl", "systemd-sysusers", "systemd-tmpfiles", "udevadm"}


def test_what_a_program_says_becomes_the_error():
    with pytest.raises(CommandFailedError, match=r"ls /nowhere: .*No such file"):
        run_command(["ls", "/nowhere"])
    with pytest.raises(NotFoundError, match="no-such-program: no such program; a service needs systemd"):
        run_command(["no-such-program"])


def test_who_may_not_write_gets_the_reason(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    def refuse(path: Path, _: str, **_options: object) -> None:
        raise PermissionError(13, "Permission denied", str(path))

    monkeypatch.setattr(apply, "replace_file", refuse)
    with pytest.raises(NotPermittedError, match=r"/etc/monstertruckd/truck.yaml: Permission denied"):
        install(truck_plan(tmp_path), tmp_path)


def test_a_simulated_truck_is_no_service(tmp_path: Path):
    with pytest.raises(ConfigError, match=r"demo.yaml: sim: is a simulated robot"):
        truck_plan(tmp_path, ROOT / "configs" / "demo.yaml")


def test_without_any_configuration_it_asks_for_one(tmp_path: Path):
    with pytest.raises(NotFoundError, match="pass the robot's with --config FILE"):
        truck_plan(tmp_path, None)


def test_files_of_a_configuration_keep_their_places(tmp_path: Path):
    (tmp_path / "robots").mkdir()
    main = tmp_path / "robots" / "mine.yaml"
    main.write_text(f"include: [{TRUCK}, ../parts/a.yaml]\npath: {{file: ../lap.csv}}\n")
    (tmp_path / "parts").mkdir()
    (tmp_path / "parts" / "a.yaml").write_text("version: 1\nplanner: null\nexplorer: null\n")
    (tmp_path / "lap.csv").write_text("x,y,yaw,direction\n")
    copied = [planned.path for planned in truck_plan(tmp_path / "root", main).files if planned.keep_previous]
    places = [str(path.relative_to("/etc/monstertruckd")) for path in copied]
    assert places == ["robots/mine.yaml", "parts/a.yaml", "lap.csv"]


def mapped(folder: Path, name: str) -> Path:
    """A configuration beside a folder of maps, with the map that it names."""
    main = folder / "mine.yaml"
    main.write_text(f"include: [{TRUCK}]\nplanner: {{map: {name}}}\nversion: 2\n")
    return main


def world(cells: int) -> WorldMap:
    grid = np.zeros((20, 30), np.int8)
    grid[:, :cells] = 100
    return WorldMap(grid, 0.05, (-1.0, -2.0))


def saved_map(place: Path, cells: int) -> None:
    text, picture = map_content(world(cells), "map.png")
    write_save(place, {"map.yaml": text.encode(), "map.png": picture}, run="one")


@pytest.mark.parametrize("name", ["maps/lab", "maps/lab/map.yaml", "maps/plain.yaml"])
def test_a_map_is_copied_whole(tmp_path: Path, name: str):
    (tmp_path / "maps").mkdir()
    saved_map(tmp_path / "maps" / "lab", 3)
    save_map(world(3), tmp_path / "maps" / "plain.yaml")
    root = tmp_path / "root"
    main = mapped(tmp_path, name)
    install(truck_plan(root, main), root)
    found = load_map(root / "etc" / "monstertruckd" / name)
    assert (found.cells == load_map(tmp_path / name).cells).all()
    config, _ = load_truck(root / "etc" / "monstertruckd" / "mine.yaml")
    assert config.planner is not None
    assert (load_map(config.planner.map).cells == found.cells).all()
    assert not install(truck_plan(root, main), root).changed, "nothing is to be done twice"


def test_another_map_of_the_folder_replaces_the_installed_one(tmp_path: Path):
    (tmp_path / "maps").mkdir()
    root, lab = tmp_path / "root", tmp_path / "maps" / "lab"
    for cells in (3, 4, 5):
        saved_map(lab, cells)
        install(truck_plan(root, mapped(tmp_path, "maps/lab")), root)
    shutil.rmtree(lab)
    saved_map(lab, 6)
    install(truck_plan(root, mapped(tmp_path, "maps/lab")), root)
    assert np.count_nonzero(load_map(root / "etc" / "monstertruckd" / "maps" / "lab").cells) == 6 * 20


def test_a_copy_that_somebody_keeps_among_the_installed_saves_is_no_save(tmp_path: Path):
    (tmp_path / "maps").mkdir()
    root, lab = tmp_path / "root", tmp_path / "maps" / "lab"
    saved_map(lab, 3)
    install(truck_plan(root, mapped(tmp_path, "maps/lab")), root)
    saves = root / "etc" / "monstertruckd" / "maps" / "lab" / "saves"
    shutil.copytree(saves / "000001", saves / "000001.bak")
    saved_map(lab, 4)
    install(truck_plan(root, mapped(tmp_path, "maps/lab")), root)
    assert np.count_nonzero(load_map(saves.parent).cells) == 4 * 20


@pytest.mark.skipif(shutil.which("systemd-sysusers") is None or os.geteuid() != 0, reason="needs systemd and root")
def test_systemd_makes_the_user_and_the_folders(tmp_path: Path):
    install(truck_plan(tmp_path), tmp_path)
    for program in (["systemd-sysusers"], ["systemd-tmpfiles", "--create"]):
        kind = "sysusers.d" if len(program) == 1 else "tmpfiles.d"
        file = str(tmp_path / "etc" / kind / "monstertruckd.conf")
        subprocess.run(
            [program[0], f"--root={tmp_path}", *program[1:], file], check=True, capture_output=True, timeout=30
        )
    groups = dict(line.split(":", 1) for line in (tmp_path / "etc/group").read_text().splitlines())
    assert groups["dialout"].endswith(":monstertruckd")
    assert groups["video"].endswith(":monstertruckd")
    assert (tmp_path / "var/lib/monstertruckd").stat().st_mode & 0o777 == 0o750
