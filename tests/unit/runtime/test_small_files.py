import os
from collections.abc import Callable
from pathlib import Path

import pytest

from monstertruck_runtime.small_files import number_of, replace_file, require_place, text_of, whole_file


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
