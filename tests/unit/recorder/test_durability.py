"""Recordings through kills and power cuts; ``benchmarks/durability.py`` does more of them."""

import random
import shutil
from pathlib import Path

import pytest

from benchmarks.durability_parts.deaths import cuts, kills
from benchmarks.durability_parts.disk import Disk, Event
from benchmarks.durability_parts.recordings import SUBJECT

ROOT = Path("/r")


def left(happened: list[tuple[str, int, int, str, bytes]], folder: Path, seed: int) -> dict[str, bytes]:
    disk = Disk(ROOT)
    for kind, inode, offset, first, second in happened:
        disk.play(Event(kind, inode, offset, first.encode(), second))
    disk.leave(folder, random.Random(seed))
    found = {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    shutil.rmtree(folder)
    return found


def test_a_disk_keeps_what_was_synced_and_any_first_part_of_the_rest(tmp_path: Path):
    made = [("O", 1, 0, "/r/a", b""), ("W", 1, 0, "", b"one"), ("S", 1, 0, "/r/a", b""), ("D", 9, 0, "/r", b"")]
    again = [("W", 1, 3, "", b"two"), ("O", 2, 0, "/r/b", b""), ("W", 2, 0, "", b"new"), ("R", 0, 0, "/r/b", b"/r/a")]
    assert left(made, tmp_path / "x", 0) == {"a": b"one"}
    outcomes = [left(made + again, tmp_path / "x", seed) for seed in range(200)]
    olds = {b"one", b"onetwo", b"one" + bytes(3)}
    news = {b"", b"new", bytes(3)}
    assert {found["a"] for found in outcomes} == olds | news, "a rename before the data of the new file, too"
    assert all(found["a"] in news or found.get("b", b"") in news for found in outcomes)


def test_names_are_kept_in_their_order_and_an_exchange_is_one(tmp_path: Path):
    made = [("M", 0, 0, "/r/f", b""), ("O", 1, 0, "/r/f/a", b""), ("M", 0, 0, "/r/g", b""), ("D", 9, 0, "/r", b"")]
    again = [("E", 0, 0, "/r/f", b"/r/g"), ("O", 2, 0, "/r/f/b", b""), ("U", 0, 0, "/r/g/a", b"")]
    outcomes = [frozenset(left(made + again, tmp_path / "x", seed)) for seed in range(100)]
    assert set(outcomes) == {frozenset({"f/a"}), frozenset({"g/a"}), frozenset({"g/a", "f/b"}), frozenset({"f/b"})}


@pytest.mark.parametrize("count", [4, pytest.param(12, marks=pytest.mark.long)])
def test_kills_lose_no_message_that_is_old_enough(tmp_path: Path, count: int):
    assert kills((SUBJECT,), count, 5, tmp_path) == {"recordings": {"kills": count, "faults": 0}}


@pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler")
@pytest.mark.parametrize("count", [8, pytest.param(24, marks=pytest.mark.long)])
def test_power_cuts_lose_no_message_that_is_old_enough(tmp_path: Path, count: int):
    assert cuts((SUBJECT,), count, 5, tmp_path) == {"recordings": {"cuts": count, "faults": 0}}
