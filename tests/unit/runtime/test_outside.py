"""The door for files from outside: every failure is a refusal with file, expectation and what was found."""

import gzip
import io
import struct
import tracemalloc
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from pydantic import TypeAdapter

from monstertruck_runtime.errors import ConfigError, InputError, NotFoundError
from monstertruck_runtime.outside import arrays, contents, lines_of, picture, reading, text_of


def raised_by(body: Callable[[], object]) -> Exception:
    with pytest.raises(InputError) as caught, reading(Path("hall.yaml"), "a map"):
        body()
    return caught.value


@pytest.mark.parametrize(
    ("body", "text"),
    [
        (lambda: zlib.decompress(b"x"), "hall.yaml: expected a map: error: Error -5"),
        (lambda: struct.unpack("<Q", b""), "hall.yaml: expected a map: error: unpack requires"),
        (lambda: {}["origin"], "hall.yaml: expected a map: KeyError: 'origin'"),
        (lambda: [].pop(), "hall.yaml: expected a map: IndexError: pop from empty list"),
        (lambda: float("x"), "hall.yaml: expected a map: could not convert string to float: 'x'"),
        (lambda: TypeAdapter(int).validate_json("[]"), "hall.yaml: expected a map: "),
        (lambda: Path("/nowhere/x").read_bytes(), "hall.yaml: cannot be read: No such file or directory"),
        (lambda: Image.open(io.BytesIO(b"x")), "hall.yaml: expected a map: cannot identify image file"),
        (lambda: zipfile.ZipFile(io.BytesIO(b"PK")), "hall.yaml: expected a map: BadZipFile: File is not a zip file"),
    ],
)
def test_any_failure_becomes_a_refusal_with_file_and_expectation(body: Callable[[], object], text: str):
    assert str(raised_by(body)).startswith(text)


@pytest.mark.parametrize(
    ("error", "text"),
    [
        (NotImplementedError(), "NotImplementedError"),
        (SyntaxError("not a TIFF"), "SyntaxError: not a TIFF"),
        (MemoryError(), "there is not enough memory for it"),
        (RecursionError("maximum"), "it is nested too deeply"),
        (ValueError("two\n  lines"), "two lines"),
        (RuntimeError("x" * 1000), "RuntimeError: " + "x" * 200),
    ],
)
def test_the_cause_is_one_short_line(error: Exception, text: str):
    def fail() -> None:
        raise error

    assert str(raised_by(fail)) == f"hall.yaml: expected a map: {text}"


def test_our_own_errors_and_interruptions_pass():
    with pytest.raises(NotFoundError, match="gone"), reading(Path("x"), "a map"):
        raise NotFoundError("gone")
    with pytest.raises(KeyboardInterrupt), reading(Path("x"), "a map"):
        raise KeyboardInterrupt
    with pytest.raises(ConfigError, match="x: expected a map: bad"), reading(Path("x"), "a map", ConfigError):
        raise ValueError("bad")


def test_a_file_that_is_too_long_or_none_is_not_read(tmp_path: Path):
    file = tmp_path / "f"
    file.write_bytes(b"12345")
    assert contents(file, "x", 5) == b"12345"
    with pytest.raises(InputError, match="5 bytes, expected at most 4"):
        contents(file, "x", 4)
    with pytest.raises(InputError, match="cannot be read: Is a directory"):
        contents(tmp_path, "x", 4)


def test_text_may_have_a_byte_order_mark_and_names_the_line_of_other_bytes(tmp_path: Path):
    file = tmp_path / "t.csv"
    file.write_bytes(b"\xef\xbb\xbfx,y\n")
    assert text_of(file, "a table", 100) == "x,y\n"
    assert list(lines_of(file, "a table")) == ["x,y\n"]
    file.write_bytes(b"x,y\n1,\xff\n")
    with pytest.raises(InputError, match=r"t\.csv:2: expected a table: not UTF-8 text"):
        text_of(file, "a table", 100)
    with pytest.raises(InputError, match=r"t\.csv:2: expected a table: not UTF-8 text"):
        list(lines_of(file, "a table"))


def test_packed_lines_are_bounded_unpacked(tmp_path: Path):
    file = tmp_path / "log.gz"
    file.write_bytes(gzip.compress(b"one\ntwo\n"))
    assert list(lines_of(file, "a log")) == ["one\n", "two\n"]
    file.write_bytes(gzip.compress(bytes(50_000_000)))
    tracemalloc.start()
    with pytest.raises(InputError, match="more than 1 MB unpacked: expected at most that"):
        list(lines_of(file, "a log", 1_000_000))
    most = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert most < 5_000_000
    file.write_bytes(gzip.compress(b"one\ntwo\n")[:-9])
    with pytest.raises(InputError, match="expected a log: EOFError"):
        list(lines_of(file, "a log"))


def test_arrays_are_bounded_unpacked(tmp_path: Path):
    file = tmp_path / "a.npz"
    np.savez_compressed(file, t=np.arange(3), deep=np.zeros((4, 0)), one=np.array(7))
    found = arrays(file, "arrays")
    assert found["t"].tolist() == [0, 1, 2]
    assert found["deep"].shape == (4, 0)
    assert found["one"] == 7
    np.savez_compressed(file, t=np.zeros(1_000_000))
    with pytest.raises(InputError, match=r"a\.npz: 8000128 bytes unpacked: expected at most 1000000"):
        arrays(file, "arrays", 1_000_000)


def test_an_array_that_says_it_is_larger_than_its_bytes_gets_no_room(tmp_path: Path):
    head = io.BytesIO()
    np.lib.format.write_array_header_1_0(head, {"descr": "<f8", "fortran_order": False, "shape": (10**9, 10**9)})
    file = tmp_path / "a.npz"
    with zipfile.ZipFile(file, "w") as archive:
        archive.writestr("t.npy", head.getvalue() + bytes(8))
    with pytest.raises(InputError, match=r"a\.npz: expected arrays: an array of shape \(1000000000, 1000000000\) in"):
        arrays(file, "arrays")


def test_objects_and_other_packings_are_no_arrays(tmp_path: Path):
    file = tmp_path / "a.npz"
    np.savez(file, t=np.array([{}], dtype=object))
    with pytest.raises(InputError, match="Object arrays cannot be loaded"):
        arrays(file, "arrays")
    with zipfile.ZipFile(file, "w", zipfile.ZIP_LZMA) as archive:
        archive.writestr("t.npy", b"x")
    with pytest.raises(InputError, match=r"t\.npy: expected arrays as NumPy packs them"):
        arrays(file, "arrays")


@pytest.mark.parametrize(("side", "text"), [(5001, "5001 x 5001 pixels"), (11_000, "121000000"), (16_000, "256000000")])
def test_a_picture_is_bounded_before_it_is_decoded(tmp_path: Path, side: int, text: str):
    file = tmp_path / "bomb.png"
    Image.new("1", (side, side)).save(file)
    with pytest.raises(InputError, match=rf"bomb\.png: .*{text}.*: expected at most 25000000"), picture(file):
        pass


def test_a_picture_that_breaks_while_it_is_decoded_is_refused(tmp_path: Path):
    file = tmp_path / "cut.png"
    Image.effect_noise((64, 64), 50).save(file)
    with picture(file) as image:
        assert np.asarray(image).shape == (64, 64)
    file.write_bytes(file.read_bytes()[:500])
    with pytest.raises(InputError, match=r"cut\.png: expected a picture: "), picture(file) as image:
        image.load()
