import errno
import fcntl
import os
import subprocess
import sys
import textwrap
from collections.abc import Callable
from pathlib import Path

import pytest

from monstertruck_runtime import small_files
from monstertruck_runtime.small_files import (
    make_folder,
    number_of,
    put_aside,
    remove_file,
    remove_leftovers,
    replace_file,
    require_place,
    sync_folder,
    text_of,
    whole_file,
)


@pytest.mark.parametrize(("content", "number"), [("42\n", 42), ("-1", -1), ("", None), ("4.2", None), ("abc", None)])
def test_numbers(tmp_path: Path, content: str, number: int | None):
    (tmp_path / "file").write_text(content)
    assert number_of(tmp_path / "file") == number


def test_what_cannot_be_read_is_none(tmp_path: Path):
    assert text_of(tmp_path / "missing") is None
    assert number_of(tmp_path / "missing") is None
    assert text_of(tmp_path) is None, "a folder"


def test_any_bytes_are_text(tmp_path: Path):
    (tmp_path / "file").write_bytes(b" \xff\n")
    assert text_of(tmp_path / "file") == r"\xff"


def test_a_replaced_file_keeps_its_mode_and_a_link_to_it_stays(tmp_path: Path):
    file, link = tmp_path / "file", tmp_path / "link"
    replace_file(file, "a", mode=0o600)
    assert file.stat().st_mode & 0o777 == 0o600
    link.symlink_to(file)
    replace_file(link, b"b")
    assert link.is_symlink()
    assert (file.read_text(), file.stat().st_mode & 0o777) == ("b", 0o600)


def test_a_file_may_take_the_place_of_a_link(tmp_path: Path):
    file, link = tmp_path / "file", tmp_path / "link"
    replace_file(file, "a", mode=0o600)
    link.symlink_to(file)
    replace_file(link, "b", follow_links=False)
    assert not link.is_symlink()
    assert (link.read_text(), link.stat().st_mode & 0o777) == ("b", 0o644)
    assert file.read_text() == "a"


@pytest.mark.parametrize("follow_links", [True, False])
@pytest.mark.parametrize("make", [os.mkfifo, os.mkdir])
def test_only_regular_files_are_replaced(tmp_path: Path, make: Callable[[Path], None], follow_links: bool):
    special = tmp_path / "special"
    make(special)
    with pytest.raises(OSError, match="Not a regular file"):
        replace_file(special, "x", follow_links=follow_links)
    (tmp_path / "link").symlink_to(special)
    with pytest.raises(OSError, match="Not a regular file"):
        replace_file(tmp_path / "link", "x")
    assert not special.is_file()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["link", "special"], "nothing is left behind"


def test_a_place_for_a_file_is_known_before_the_work(tmp_path: Path):
    require_place(tmp_path / "new.gif")
    assert list(tmp_path.iterdir()) == []
    for wrong in (tmp_path, tmp_path / "nowhere" / "x.gif", Path("/proc/x.gif")):
        with pytest.raises(OSError, match=str(wrong)):
            require_place(wrong)


def test_a_file_that_is_written_piece_by_piece_is_there_as_a_whole_or_not_at_all(tmp_path: Path):
    file = tmp_path / "file"
    for content in ("a", "b"):
        with whole_file(file) as part:
            part.write_text(content)
        assert [(path, path.read_text()) for path in tmp_path.iterdir()] == [(file, content)]

    def broken_off() -> None:
        with whole_file(file) as part:
            part.write_text("half of")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        broken_off()
    assert [(path, path.read_text()) for path in tmp_path.iterdir()] == [(file, "b")]


def test_a_full_disk_names_the_file(tmp_path: Path):
    def written() -> None:
        with whole_file(tmp_path / "file"):
            raise OSError(errno.ENOSPC, "No space left on device")

    with pytest.raises(OSError, match=r"No space left on device: '.*/file'"):
        written()


def test_a_disk_that_takes_nothing_keeps_its_own_words(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Nothing can be removed there either."""

    def refuse(*_: object, **__: object) -> None:
        raise OSError(errno.EROFS, "Read-only file system")

    monkeypatch.setattr(small_files.Path, "unlink", refuse)

    def written() -> None:
        with whole_file(tmp_path / "file"):
            raise OSError(errno.EIO, "Input/output error")

    with pytest.raises(OSError, match="Input/output error"):
        written()


def test_damaged_files_are_kept_side_by_side(tmp_path: Path):
    file = tmp_path / "estop"
    for content in ("a", "b"):
        file.write_text(content)
        said = put_aside(file)
    assert said == "the file is kept as estop.damaged-2"
    assert {path.name: path.read_text() for path in tmp_path.iterdir()} == {
        "estop.damaged": "a",
        "estop.damaged-2": "b",
    }
    assert put_aside(file) == "the file cannot be renamed: No such file or directory"


def test_a_file_takes_the_place_of_no_folder_and_no_pipe_and_a_link_to_one_stays(tmp_path: Path):
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "folder").mkdir()
    for name in ("pipe", "folder"):
        with pytest.raises(OSError, match=name), whole_file(tmp_path / name):
            pytest.fail("begun")
    link, file = tmp_path / "link", tmp_path / "folder" / "file"
    link.symlink_to(file)
    with whole_file(link) as part:
        part.write_text("a")
    assert link.is_symlink()
    assert file.read_text() == "a"


@pytest.fixture
def steps(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """What is done to the disk, in order: names that are synced, replaced and removed."""
    done: list[str] = []
    fsync, replace, unlink = os.fsync, Path.replace, Path.unlink

    def note_sync(file: int) -> None:
        fsync(file)
        done.append(f"sync {Path(f'/proc/self/fd/{file}').readlink().name.partition('.')[0]}")

    def note_replace(path: Path, target: Path) -> Path:
        done.append(f"replace {target.name}")
        return replace(path, target)

    def note_unlink(path: Path, missing_ok: bool = False) -> None:
        done.append(f"remove {path.name}")
        unlink(path, missing_ok)

    monkeypatch.setattr(os, "fsync", note_sync)
    monkeypatch.setattr(Path, "replace", note_replace)
    monkeypatch.setattr(Path, "unlink", note_unlink)
    return done


def test_contents_are_on_the_disk_before_the_name_and_the_name_before_the_return(tmp_path: Path, steps: list[str]):
    folder = tmp_path / "outer" / "inner"
    make_folder(folder, 0o700)
    assert steps == ["sync outer", f"sync {tmp_path.name}"]
    assert folder.stat().st_mode & 0o777 == 0o700
    make_folder(folder)
    assert len(steps) == 2, "what is there is not synced again"
    steps.clear()
    replace_file(folder / "file", "a")
    assert steps == ["sync file", "replace file", "sync inner"]
    steps.clear()
    with whole_file(folder / "long") as part:
        part.write_text("a")
    assert steps == ["sync long", "replace long", "sync inner"]
    steps.clear()
    remove_file(folder / "file")
    assert steps == ["remove file", "sync inner"]
    remove_file(folder / "file")
    remove_file(folder / "nowhere" / "file")


def test_a_folder_that_no_file_system_can_sync_is_no_failure(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    def broken(number: int) -> None:
        def fsync(_: int) -> None:
            raise OSError(number, os.strerror(number))

        monkeypatch.setattr(os, "fsync", fsync)

    broken(errno.EINVAL)
    sync_folder(tmp_path)
    broken(errno.EIO)
    with pytest.raises(OSError, match=os.strerror(errno.EIO)):
        sync_folder(tmp_path)


def test_what_a_killed_writer_left_is_removed_and_what_is_being_written_stays(tmp_path: Path):
    writer = textwrap.dedent("""
        import os, sys, time
        from pathlib import Path
        from monstertruck_runtime.small_files import replace_file

        def stop(_):
            print("written", flush=True)
            time.sleep(60)

        os.fsync = stop
        replace_file(Path(sys.argv[1]), "new")
    """)
    (tmp_path / "file").write_text("old")
    (tmp_path / "folder.new~").mkdir()
    (tmp_path / "link.new~").symlink_to(tmp_path / "file")
    with subprocess.Popen([sys.executable, "-c", writer, str(tmp_path / "file")], stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == b"written\n"
        assert remove_leftovers(tmp_path) == []
        process.kill()
        process.wait()
    (left,) = remove_leftovers(tmp_path)
    assert left.name.startswith("file.")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["file", "folder.new~", "link.new~"]
    assert (tmp_path / "file").read_text() == "old"
    assert remove_leftovers(tmp_path / "nowhere") == []


def test_a_leftover_that_is_removed_before_it_is_locked_is_written_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    flock, removed = fcntl.flock, []

    def sweep_first(handle: int, how: int) -> None:
        if not removed and how == fcntl.LOCK_EX:
            removed.append(0)
            removed[:] = remove_leftovers(tmp_path)
        flock(handle, how)

    monkeypatch.setattr(fcntl, "flock", sweep_first)
    replace_file(tmp_path / "file", "a")
    assert len(removed) == 1
    assert [(path.name, path.read_text()) for path in tmp_path.iterdir()] == [("file", "a")]
