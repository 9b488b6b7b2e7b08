"""Saves of maps: whole or not there, of one run, with a way back; folders of earlier versions."""

import os
import shutil
import threading
from pathlib import Path

import pytest

from monstertruck_runtime import map_folders
from monstertruck_runtime.errors import InputError
from monstertruck_runtime.map_folders import MANIFEST, SAVES, YAML, folder_of, opened, tidy, write_save

GRID = (YAML, "map.png", "graph.npz")
POINTS = ("points.json", "point-*.jpg")


def grid(version: str) -> dict[str, bytes]:
    return {name: f"{name} {version}".encode() for name in GRID}


def read(folder: Path) -> dict[str, str]:
    """Content by name of the save that counts."""
    with opened(folder) as save:
        names = [path.name for path in save.folder.iterdir()] if save.folder.is_dir() else []
        names += [path.name for path in save.beside.iterdir()] if save.beside else []
        return {n: save.file(n).read_text() for n in names if n != MANIFEST and save.file(n).is_file()}


def saves(folder: Path) -> list[str]:
    return sorted(path.name for path in (folder / SAVES).iterdir())


def test_a_save_takes_over_what_its_run_saved_before_and_nothing_of_another_one(tmp_path: Path):
    write_save(tmp_path, grid("a"), GRID, "one")
    write_save(tmp_path, {"ground.npz": b"soft"}, run="one")
    write_save(tmp_path, {"points.json": b"[1]", "point-x.jpg": b"x"}, POINTS, "one")
    write_save(tmp_path, {"points.json": b"[2]"}, POINTS, "one")
    whole = {name: f"{name} a" for name in GRID} | {"ground.npz": "soft", "points.json": "[2]"}
    assert read(tmp_path) == whole
    write_save(tmp_path, {"points.json": b"[3]"}, POINTS)
    assert read(tmp_path) == whole | {"points.json": "[3]"}, "whoever loads the map adds to it"
    write_save(tmp_path, {"ground.npz": b"hard"}, run="two")
    assert read(tmp_path) == whole | {"points.json": "[3]"}, "the new run has no map yet"
    write_save(tmp_path, grid("b"), GRID, "two")
    assert read(tmp_path) == {name: f"{name} b" for name in GRID} | {"ground.npz": "hard"}


def test_parts_that_are_left_out_go_and_those_taken_over_are_not_written_again(tmp_path: Path):
    def file(number: int) -> int:
        return (tmp_path / SAVES / f"{number:06d}" / YAML).stat().st_ino

    write_save(tmp_path, grid("a"), GRID, "one")
    write_save(tmp_path, {"points.json": b"[]"}, POINTS, "one")
    assert file(2) == file(1)
    parts = grid("a")
    del parts["graph.npz"]
    assert write_save(tmp_path, parts, GRID, "one") == tmp_path / SAVES / "000003"
    assert file(3) != file(2), "damage to one does not harm the other"
    assert set(read(tmp_path)) == {YAML, "map.png", "points.json"}
    write_save(tmp_path, {}, POINTS, "one")
    assert write_save(tmp_path, {}, POINTS, "one", new=False) is None


def test_the_save_before_and_the_last_two_maps_are_kept(tmp_path: Path):
    for version in "abc":
        write_save(tmp_path, grid(version), GRID, version)
    assert saves(tmp_path) == ["000002", "000003"]
    for _ in range(3):
        write_save(tmp_path, {"points.json": b"[]"}, POINTS, "d")
    assert saves(tmp_path) == ["000002", "000003", "000005", "000006"]
    assert read(tmp_path)[YAML] == f"{YAML} c"
    for _ in range(3):
        write_save(tmp_path, {"points.json": b"[]"}, POINTS)
    assert saves(tmp_path) == ["000002", "000008", "000009"], "one whose grid is another file"


def test_a_run_that_saves_often_leaves_the_map_of_the_run_before(tmp_path: Path):
    write_save(tmp_path, grid("yesterday, early"), GRID, "yesterday")
    write_save(tmp_path, grid("yesterday"), GRID, "yesterday")
    for minute in range(5):
        write_save(tmp_path, grid(f"minute {minute}"), GRID, "today")
        if minute == 1:
            (tmp_path / SAVES / "000003" / MANIFEST).write_text("damaged")
    assert saves(tmp_path) == ["000002", "000006", "000007"]
    assert (tmp_path / SAVES / "000002" / YAML).read_text() == f"{YAML} yesterday"


@pytest.mark.parametrize("name", [*GRID, MANIFEST])
@pytest.mark.parametrize("harm", ["flip", "cut", "gone", "of another save"])
def test_a_damaged_or_mixed_save_is_refused_for_the_one_before(tmp_path: Path, name: str, harm: str):
    write_save(tmp_path, grid("a"), GRID, "one")
    write_save(tmp_path, grid("b"), GRID, "two")
    write_save(tmp_path, grid("c"), GRID, "two")
    file = tmp_path / SAVES / "000003" / name
    data = bytearray(file.read_bytes())
    file.unlink()
    if harm == "flip":
        data[len(data) // 2] ^= 1
        file.write_bytes(data)
    elif harm == "cut":
        file.write_bytes(data[:-3])
    elif harm == "of another save":
        file.write_bytes((tmp_path / SAVES / "000002" / name).read_bytes())
    with opened(tmp_path) as save:
        assert save.folder.name == "000002"
        (remark,) = save.remarks
    assert f"000003/{name if name != MANIFEST else ''}" in remark
    assert remark.endswith("; an older save is loaded instead")
    write_save(tmp_path, {"points.json": b"[]"}, POINTS)
    assert read(tmp_path) == {n: f"{n} b" for n in GRID} | {"points.json": "[]"}, (
        "what is added is added to the whole one"
    )


def test_all_saves_damaged_is_an_error_that_names_each(tmp_path: Path):
    for version in "ab":
        write_save(tmp_path, grid(version), GRID, version)
    for number in ("000001", "000002"):
        (tmp_path / SAVES / number / YAML).write_text("?")
    with pytest.raises(InputError, match=r"000002/map\.yaml: 1 bytes, .*; .*000001/map\.yaml"), opened(tmp_path):
        pytest.fail("opened")
    write_save(tmp_path, grid("c"), GRID, "c")
    assert read(tmp_path)[YAML] == f"{YAML} c"


@pytest.mark.parametrize("parts", ['{"../x": {"size": 0, "sha256": "%s"}}' % ("0" * 64), "[]", "3"])
def test_a_manifest_from_outside_names_no_file_elsewhere(tmp_path: Path, parts: str):
    write_save(tmp_path, grid("a"), GRID, "one")
    (tmp_path / "saves" / "000001" / MANIFEST).write_text(f'{{"version": 1, "run": "", "parts": {parts}}}')
    with pytest.raises(InputError, match=r"manifest\.json: expected the manifest of a saved map"), opened(tmp_path):
        pytest.fail("opened")


def test_folders_of_earlier_versions_are_read_and_replaced_by_a_new_map(tmp_path: Path):
    for name in (*GRID, "ground.npz", "points.json", "point-a.jpg"):
        (tmp_path / name).write_text("old")
    (tmp_path / "notes.txt").write_text("mine")
    assert read(tmp_path)[YAML] == "old"
    write_save(tmp_path, {"points.json": b"[1]"}, POINTS)
    assert read(tmp_path) | {"notes.txt": ""} == {
        **dict.fromkeys((*GRID, "ground.npz", "point-a.jpg"), "old"), "points.json": "[1]", "notes.txt": "",
    }  # fmt: skip
    assert (tmp_path / YAML).exists(), "files of another program stay, unless a new map takes their place"
    write_save(tmp_path, grid("b"), GRID, "new")
    assert read(tmp_path) == {name: f"{name} b" for name in GRID}
    assert sorted(path.name for path in tmp_path.iterdir()) == ["notes.txt", SAVES]


def test_a_map_is_named_by_its_folder_or_by_the_yaml_that_was_in_it(tmp_path: Path):
    assert folder_of(tmp_path) == tmp_path
    assert folder_of(tmp_path / YAML) is None
    write_save(tmp_path, grid("a"), GRID, "one")
    assert folder_of(tmp_path / YAML) == tmp_path
    assert folder_of(tmp_path / "hall.yaml") is None
    assert read(tmp_path / "nowhere") == {}


@pytest.mark.parametrize("step", ["fsync", "rename", "hardlink_to"])
def test_a_save_that_fails_leaves_the_one_before_and_nothing_else(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, step: str
):
    write_save(tmp_path, grid("a"), GRID, "one")
    before = read(tmp_path)

    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as broken:
        broken.setattr(os if step == "fsync" else Path, step, full)
        with pytest.raises(OSError, match="No space"):
            write_save(tmp_path, {"points.json": b"[]"}, POINTS, "one")
    assert read(tmp_path) == before
    assert saves(tmp_path) == ["000001"]


def test_where_files_have_one_name_only_they_are_copied(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    def refuse(*_: object) -> None:
        raise OSError(1, "Operation not permitted")

    write_save(tmp_path, grid("a"), GRID, "one")
    monkeypatch.setattr(Path, "hardlink_to", refuse)
    write_save(tmp_path, {"points.json": b"[]"}, POINTS, "one")
    assert read(tmp_path) == {n: f"{n} a" for n in GRID} | {"points.json": "[]"}


def test_the_last_step_is_one_rename_and_everything_is_synced_before(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    write_save(tmp_path, grid("a"), GRID, "one")
    done: list[str] = []
    fsync, rename = os.fsync, Path.rename

    def note_sync(file: int) -> None:
        fsync(file)
        done.append(Path(f"/proc/self/fd/{file}").readlink().name)

    def note_rename(path: Path, target: Path) -> Path:
        done.append(f"rename {target.name}")
        return rename(path, target)

    monkeypatch.setattr(os, "fsync", note_sync)
    monkeypatch.setattr(Path, "rename", note_rename)
    write_save(tmp_path, {"points.json": b"[]", "point-a.jpg": b"a"}, POINTS, "one")
    written, switch, last = done[:-3], done[-2], done[-1]
    assert (sorted(written), switch, last) == (["manifest.json", "point-a.jpg", "points.json"], "rename 000002", SAVES)
    assert done[-3].endswith(map_folders.SCRATCH), "the names in the fresh folder"


def test_what_a_killed_writer_left_is_removed(tmp_path: Path):
    write_save(tmp_path, grid("a"), GRID, "one")
    for number in range(2):
        left = tmp_path / SAVES / f"tmp{number}{map_folders.SCRATCH}"
        left.mkdir()
        (left / YAML).write_text("half")
        assert read(tmp_path)[YAML] == f"{YAML} a"
        if number:
            assert tidy(tmp_path) == [left]
        else:
            write_save(tmp_path, grid("b"), GRID, "one")
        assert not left.exists()
        shutil.rmtree(tmp_path / SAVES / "000002", ignore_errors=True)
    assert tidy(tmp_path / "nowhere") == []


def test_a_save_that_is_read_stays_until_it_is_read(tmp_path: Path):
    write_save(tmp_path, grid("0"), GRID, "one")
    done = threading.Event()

    def write_on() -> None:
        for version in range(5):
            write_save(tmp_path, grid(str(version)), GRID, f"run {version}")
        done.set()

    with opened(tmp_path) as save:
        writer = threading.Thread(target=write_on)
        writer.start()
        assert not done.wait(0.2)
        assert save.file(YAML).read_text() == f"{YAML} 0"
    writer.join()
    assert saves(tmp_path) == ["000005", "000006"]
