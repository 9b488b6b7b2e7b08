"""The latch's files: how they are opened, written, read and removed."""

import os
import stat
from pathlib import Path

import pytest

from monstertruckd.gate.latch import EstopLatch, Mark, MemoryLatch, marks_folder


@pytest.fixture
def run(tmp_path):
    (tmp_path / "run").mkdir()
    return tmp_path / "run"


@pytest.fixture
def latch(tmp_path, run):
    return EstopLatch(tmp_path / "state" / "deep" / "estop", run)


def open_files():
    return len(list(Path("/proc/self/fd").iterdir()))


def mode(path):
    return stat.S_IMODE(path.stat().st_mode)


def test_a_latch_in_memory_is_what_was_stored():
    latch = MemoryLatch()
    assert (latch.engaged(), latch.stored()) == (False, False)
    latch.mark(True)
    assert not latch.engaged()
    latch.store(True)
    assert (latch.engaged(), latch.stored()) == (True, True)
    latch.close()
    latch.store(False)
    assert not latch.engaged()
    assert MemoryLatch(True).engaged()


def test_a_new_mark_is_one_byte_of_a_file_of_its_user_alone(run):
    mark = Mark(run / "mark")
    assert not mark.engaged()
    assert (run / "mark").read_bytes() == b"0"
    assert mode(run / "mark") == 0o600
    assert not os.get_inheritable(mark._file)
    mark.set(marked=True)
    assert (run / "mark").read_bytes() == b"1"
    assert mark.engaged()
    mark.set(marked=False)
    assert (run / "mark").read_bytes() == b"0"
    before = open_files()
    mark.close()
    assert not (run / "mark").exists()
    assert open_files() == before - 1


@pytest.mark.parametrize(("contents", "engaged"), [(b"0", False), (b"1", True), (b"00", True), (b"x", True)])
def test_what_a_mark_says_is_kept_over_a_restart(run, contents, engaged):
    (run / "mark").write_bytes(contents)
    assert Mark(run / "mark").engaged() is engaged
    assert (run / "mark").read_bytes() == contents


def test_a_mark_that_vanished_can_still_be_closed(run):
    mark = Mark(run / "mark")
    (run / "mark").unlink()
    mark.close()


@pytest.mark.parametrize("what", ["link", "hard link", "folder", "pipe", "another's"])
def test_what_is_no_file_of_its_user_alone_is_no_mark(run, what, monkeypatch):
    path = run / "mark"
    (run / "other").write_bytes(b"0")
    match what:
        case "link":
            path.symlink_to(run / "other")
        case "hard link":
            path.hardlink_to(run / "other")
        case "folder":
            path.mkdir()
        case "pipe":
            os.mkfifo(path)
        case "another's":
            path.write_bytes(b"0")
            monkeypatch.setattr(os, "geteuid", lambda: 12345)
    before = open_files()
    with pytest.raises(OSError, match="mark"):
        Mark(path)
    assert open_files() == before


def test_preparing_leaves_a_mark_and_no_draft(latch, tmp_path, run):
    before = open_files()
    latch.prepare()
    assert open_files() == before + 1
    assert list((tmp_path / "state" / "deep").iterdir()) == []
    assert [path.read_bytes() for path in run.iterdir()] == [b"0"]
    latch.prepare()
    latch.close()
    assert list(run.iterdir()) == []
    latch.close()
    latch.mark(True)
    assert list(run.iterdir()) == []


def test_a_place_where_nothing_can_be_stored_is_found_when_preparing(tmp_path, run):
    (tmp_path / "file").touch()
    with pytest.raises(FileExistsError):
        EstopLatch(tmp_path / "file" / "estop", run).prepare()
    with pytest.raises(FileNotFoundError):
        EstopLatch(tmp_path / "estop", tmp_path / "nowhere").prepare()


def test_file_and_mark_each_engage_the_latch(latch, tmp_path):
    assert not latch.engaged()
    latch.mark(True)
    assert not latch.engaged(), "not prepared"
    latch.prepare()
    latch.mark(True)
    assert (latch.engaged(), latch.stored()) == (True, False)
    latch.store(True)
    latch.mark(False)
    assert (latch.engaged(), latch.stored()) == (True, True)
    latch.store(False)
    assert (latch.engaged(), latch.stored()) == (False, False)


def test_a_file_that_cannot_be_looked_for_is_not_known_and_engages_the_latch(tmp_path, run):
    (tmp_path / "file").touch()
    latch = EstopLatch(tmp_path / "file" / "estop", run)
    assert (latch.engaged(), latch.stored()) == (True, None)


def test_the_file_is_readable_and_says_what_it_is(latch, tmp_path):
    latch.store(True)
    file = tmp_path / "state" / "deep" / "estop"
    assert file.read_text() == "emergency stop latched\n"
    assert mode(file) == 0o644
    latch.store(True)
    assert [path.name for path in file.parent.iterdir()] == ["estop"]


def test_storing_leaves_nothing_open(latch):
    latch.store(True)
    before = open_files()
    for engaged in (True, False, False, True):
        latch.store(engaged)
    assert open_files() == before


def test_a_folder_that_cannot_be_synced_is_an_error_and_leaves_nothing_open(latch, monkeypatch):
    latch.store(True)
    before = open_files()

    def fsync(file):
        raise OSError("disk")

    monkeypatch.setattr(os, "fsync", fsync)
    for engaged in (True, False):
        with pytest.raises(OSError, match="disk"):
            latch.store(engaged)
        assert open_files() == before


def test_every_latch_has_a_mark_of_its_own_whatever_way_leads_to_it(tmp_path, run):
    def mark_of(path):
        latch = EstopLatch(path, run)
        latch.prepare()
        (name,) = [found.name for found in run.iterdir()]
        latch.close()
        return name

    (tmp_path / "a").mkdir()
    (tmp_path / "b").symlink_to(tmp_path / "a")
    assert mark_of(tmp_path / "a" / "estop") == mark_of(tmp_path / "b" / "estop")
    assert mark_of(tmp_path / "a" / "estop") != mark_of(tmp_path / "c" / "estop")
    assert mark_of(tmp_path / "a" / "estop").startswith("monstertruckd-estop-")


def test_a_link_in_the_place_of_the_file_is_replaced_and_not_followed(latch, tmp_path):
    folder = tmp_path / "state" / "deep"
    folder.mkdir(parents=True)
    (folder / "estop").symlink_to(tmp_path / "victim")
    latch.store(True)
    assert not (tmp_path / "victim").exists()
    assert not (folder / "estop").is_symlink()
    assert (folder / "estop").read_text() == "emergency stop latched\n"


def test_marks_are_where_they_are_configured_given_or_usual(tmp_path, run):
    assert marks_folder(run, {"RUNTIME_DIRECTORY": "/x"}) == run
    assert str(marks_folder(None, {"RUNTIME_DIRECTORY": "/x:/y"}, tmp_path)) == "/x"
    user = tmp_path / f"run/user/{os.geteuid()}"
    assert marks_folder(None, {"RUNTIME_DIRECTORY": ""}, tmp_path) == run
    user.mkdir(parents=True)
    assert marks_folder(None, {}, tmp_path) == user
    assert marks_folder(None, {}, tmp_path / "none") == tmp_path / "none" / "dev/shm"
