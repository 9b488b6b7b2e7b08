from pathlib import Path

import pytest

from monstertruck_runtime.small_files import number_of, text_of


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
    assert text_of(tmp_path / "file") == "\ufffd"
