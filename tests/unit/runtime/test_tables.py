"""Tables of other programs."""

from pathlib import Path

import pytest

from monstertruck_planners.track.paths import load_path
from monstertruck_runtime.errors import InputError
from monstertruck_runtime.tables import read_table

ROWS = [(1, ["x", "y"]), (2, ["1", "2"])]


@pytest.mark.parametrize(
    ("data", "rows"),
    [
        (b"x,y\n1,2\n", ROWS),
        (b"\xef\xbb\xbfx,y\r\n1,2\r\n", ROWS),
        (b"x;y\n1;2\n\n\n", ROWS),
        (b"x\ty\n1\t2", ROWS),
        (b"x , y\n 1, 2 \n  \n", ROWS),
        (b"# made by hand\n\nx,y\n# begin\n1,2\n,,\n", [(3, ["x", "y"]), (5, ["1", "2"])]),
        (b'"x","y"\n1,2\n', ROWS),
        (b"sep=;\r\nx;y\r\n1;2\r\n", [(2, ["x", "y"]), (3, ["1", "2"])]),
        (b"sep=\t\nx\ty\n1\t2\n", [(2, ["x", "y"]), (3, ["1", "2"])]),
        (b"x y\n1   2\n", ROWS),
        (b"x,\ty\t\n1,\t2\n", ROWS),
        (b"0,5\t1\n", [(1, ["0.5", "1"])]),
        (b"x,y,\n1,2,\n", ROWS),
        (b"x;y\n1,5;-2,5e-1\n", [(1, ["x", "y"]), (2, ["1.5", "-2.5e-1"])]),
        (b"0,5;1,0;2,0\n", [(1, ["0.5", "1.0", "2.0"])]),
        (b"", []),
    ],
)
def test_marks_empty_lines_comments_and_delimiters(tmp_path: Path, data: bytes, rows: list[tuple[int, list[str]]]):
    (tmp_path / "t.csv").write_bytes(data)
    assert read_table(tmp_path / "t.csv", "a table", 1000) == rows


@pytest.mark.parametrize(
    ("data", "text"),
    [
        (b"x,y,yaw,direction\n0,0,0,1\n1,a,0,1\n", r"p\.csv:3: expected numbers, found 1,a,0,1"),
        (b"x;y;yaw;direction\n0;0;0;1\n1.000,5;0;0;1\n", r"p\.csv:3: expected numbers, found 1\.000,5,0,0,1"),
        (b"x,y,x\n0,0,5\n1,0,5\n", r"p\.csv:1: expected one column x, found 2"),
        (b"x [mm],y [mm]\n0,0\n1,0\n", r"p\.csv:1: column x \[mm\]: expected the unit m"),
        (b"x [m],y [m/s]\n0,0\n1,0\n", r"p\.csv:1: column y \[m/s\]: expected the unit m"),
        (b"# y x v\n0 1\n1 1\n", r"p\.csv:1: names 3 columns: expected 2, as in line 2"),
        (b"\n# path\na,b\n", r"p\.csv:3: expected columns x,y,yaw,direction, or x_m and y_m .*; found a,b"),
        (b"", r"p\.csv: expected a path: the file is empty"),
        (b"x,y,yaw,direction\n\xff\n", r"p\.csv:2: expected a path: not UTF-8 text"),
    ],
)
def test_a_path_names_what_it_met(tmp_path: Path, data: bytes, text: str):
    (tmp_path / "p.csv").write_bytes(data)
    with pytest.raises(InputError, match=text):
        load_path(tmp_path / "p.csv", closed=False)


@pytest.mark.parametrize("head", [b"x;y;yaw;direction", b"X [m];Y (m);yaw [rad];direction"])
def test_a_path_of_a_spreadsheet_is_read(tmp_path: Path, head: bytes):
    (tmp_path / "p.csv").write_bytes(b"\xef\xbb\xbf" + head + b"\r\n0;0;0;1\r\n0,5;0;0;1\r\n\r\n")
    path = load_path(tmp_path / "p.csv", closed=False)
    assert list(path.poses) == [0.0, 0.0, 0.0, 0.5, 0.0, 0.0]
