"""Plain data as YAML 1.2."""

from pathlib import Path

import pytest

from monstertruck_runtime.errors import InputError
from monstertruck_runtime.yaml_files import read_yaml, yaml_text


def test_what_is_written_is_read_back_in_its_order(tmp_path: Path):
    value = {"robot": "ä: x", "b": [1, -2.0, [1e-7]], "a": {"word": "yes", "number": "1e3", "none": None, "on": True}}
    file = tmp_path / "a.yaml"
    file.write_text(yaml_text(value), encoding="utf-8")
    assert read_yaml(file) == value
    assert list(read_yaml(file)) == ["robot", "b", "a"]


def test_it_is_version_1_2(tmp_path: Path):
    file = tmp_path / "a.yaml"
    file.write_text("[yes, 1e-1, 0o10, 010, 1:30]")
    assert read_yaml(file) == ["yes", 0.1, 8, 10, "1:30"]


@pytest.mark.parametrize(
    ("data", "complaint"),
    [
        (b"a: 1\nb: [", r"a\.yaml:2: not valid YAML"),
        (b"a: 1\na: 2\n", r"a\.yaml:2: not valid YAML: found duplicate key"),
        (b"a: \x01", r"a\.yaml: expected YAML: "),
        (b"a: 1\nb: \xff", r"a\.yaml:2: expected YAML: not UTF-8 text"),
        (b"a: 2026-13-99", r"a\.yaml: expected YAML: "),
        (b"a: 1\nb: " + b"[" * 60, r"a\.yaml:2: nested more than 50 times"),
        (b"a: &a [*a]", r"a\.yaml:1: not valid YAML: an alias inside its own anchor"),
        (b"[" + b"0," * 20_001 + b"]", r"a\.yaml:1: not valid YAML: more than 20000 keys and values"),
        (
            b"\n".join(b"- &l%d [%s]" % (n, b",".join([b"*l%d" % (n - 1) if n else b"0"] * 10)) for n in range(9)),
            r"a\.yaml:5: not valid YAML: more than 20000 keys and values",
        ),
        (None, r"a\.yaml: cannot be read: .*No such file"),
    ],
)
def test_complaints_name_the_file(tmp_path: Path, data: bytes | None, complaint: str):
    file = tmp_path / "a.yaml"
    if data is not None:
        file.write_bytes(data)
    with pytest.raises(InputError, match=complaint):
        read_yaml(file)


def test_a_byte_order_mark_and_repeated_values_are_read(tmp_path: Path):
    file = tmp_path / "a.yaml"
    file.write_bytes(b"\xef\xbb\xbfa: &one [1, 2]\nb: [*one, *one]\n")
    assert read_yaml(file) == {"a": [1, 2], "b": [[1, 2], [1, 2]]}
