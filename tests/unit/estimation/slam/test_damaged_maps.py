"""Damaged files of maps: whatever is in them is read, left out, or refused by name; never a library's exception."""

import io
import random
import re
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from benchmarks.durability_parts import maps
from monstertruck_estimation.ground.grid import GroundGrid
from monstertruck_estimation.points import files
from monstertruck_estimation.slam import storage
from monstertruck_runtime.errors import InputError
from monstertruck_runtime.map_folders import opened

READERS = (storage.load, GroundGrid.load, files.load)


@pytest.fixture(scope="module")
def loose(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """Files of a map, as earlier versions and other programs leave them: no manifest guards them."""
    folder = tmp_path_factory.mktemp("whole")
    storage.save(folder, maps._patch(1, 2), maps._graph(1, 2), "run")
    maps._ground(1, 2).save(folder, "run")
    files.save(folder, maps._points(1, 2), "run")
    with opened(folder) as save:
        return {path.name: path.read_bytes() for path in save.folder.iterdir() if path.name != "manifest.json"}


def damaged(data: bytes, rng: random.Random) -> bytes:
    """Some bytes flipped, cut, doubled, moved or overwritten."""
    changed = bytearray(data)
    for _ in range(rng.choice((1, 1, 2, 8))):
        at, length = rng.randrange(len(changed) + 1), rng.choice((1, 2, 8, 100))
        match rng.randrange(6):
            case 0 if at < len(changed):
                changed[at] ^= 1 << rng.randrange(8)
            case 1:
                del changed[at:]
            case 2:
                del changed[at : at + length]
            case 3:
                changed[at:at] = changed[at : at + length]
            case 4:
                changed[at : at + length] = bytes(length)
            case 5:
                changed[at : at + length] = rng.randbytes(length)
    return bytes(changed)


def number_changed(data: bytes, rng: random.Random) -> bytes:
    """A number of a text file replaced by an odd one."""
    words = data.decode().split(" ")
    words[rng.randrange(len(words))] = rng.choice(("nan", "-1", "1e400", "[]", "null", "9" * 400, '"x"', "{}", "&a *a"))
    return " ".join(words).encode()


def array_changed(data: bytes, rng: random.Random) -> bytes:
    """An array of an npz file of another type, shape or content, well packed."""
    with np.load(io.BytesIO(data)) as file:
        arrays = dict(file)
    name = rng.choice(sorted(arrays))
    old = arrays[name]
    arrays[name] = rng.choice([
        old.astype("U8"), old.astype(complex), old[:0] if old.ndim else old.reshape(1, 1), old.astype(bool), -old - 7,
        np.zeros(3), np.full_like(old, np.nan, dtype=float), np.array("text"), old[None], old.astype("datetime64[s]"),
    ])  # fmt: skip
    out = io.BytesIO()
    np.savez(out, **arrays)
    return out.getvalue()


def bomb(_: bytes, rng: random.Random) -> bytes:
    """A small file that unpacks to gigabytes, or says that it does."""
    if rng.random() < 0.5:
        head, out = io.BytesIO(), io.BytesIO()
        np.lib.format.write_array_header_1_0(head, {"descr": "<f8", "fortran_order": False, "shape": (10**12, 2)})
        with zipfile.ZipFile(out, "w") as archive:
            archive.writestr("version.npy", head.getvalue())
        return out.getvalue()
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as archive, archive.open("poses.npy", "w") as member:
        for _ in range(300):
            member.write(bytes(10**6))
    return out.getvalue()


CHANGES = (damaged, damaged, damaged, number_changed, array_changed)


def refusal(load: Callable[[Path], object], folder: Path) -> str | None:
    """Why a folder is refused; None if it is read."""
    try:
        load(folder)
    except InputError as error:
        return str(error)
    return None


@pytest.mark.parametrize("seed", range(8))
def test_a_damaged_file_is_read_left_out_or_refused_by_name(loose: dict[str, bytes], tmp_path: Path, seed: int):
    rng = random.Random(seed)
    for name, data in loose.items():
        (tmp_path / name).write_bytes(data)
    for _ in range(40):
        name = rng.choice(sorted(loose))
        change = rng.choice(CHANGES)
        if (change is number_changed and not name.endswith(("yaml", "json"))) or (
            change is array_changed and not name.endswith("npz")
        ):
            change = damaged
        (tmp_path / name).write_bytes(change(loose[name], rng))
        for load in READERS:
            assert str(tmp_path) in (refusal(load, tmp_path) or str(tmp_path))
        (tmp_path / name).write_bytes(loose[name])


@pytest.mark.parametrize("seed", range(4))
def test_a_bomb_is_refused_before_it_is_unpacked(loose: dict[str, bytes], tmp_path: Path, seed: int):
    for name, data in loose.items():
        (tmp_path / name).write_bytes(data)
    for name in ("graph.npz", "ground.npz"):
        (tmp_path / name).write_bytes(bomb(b"", random.Random(seed)))
    assert "the map is used without keyframes" in storage.load(tmp_path).grid.remarks[0]
    with pytest.raises(InputError, match=r"ground\.npz: .*bytes"):
        GroundGrid.load(tmp_path)


@pytest.mark.parametrize(
    ("name", "value", "expected"),
    [
        ("variances", 0.0, "variances: expected numbers above 0"),
        ("points", 1e12, "surfaces over .* expected at most 25000000 cells"),
        ("poses", 1e9, "surfaces over .* expected at most 25000000 cells"),
    ],
)
def test_a_graph_that_no_search_could_use_is_left_out(
    loose: dict[str, bytes], tmp_path: Path, name: str, value: float, expected: str
):
    for file, data in loose.items():
        (tmp_path / file).write_bytes(data)
    with np.load(io.BytesIO(loose["graph.npz"])) as file:
        arrays = dict(file)
    arrays[name][3] = value, -value, *[0.0] * (arrays[name].shape[1] - 2)
    np.savez(tmp_path / "graph.npz", **arrays)
    saved = storage.load(tmp_path)
    assert saved.graph is None
    assert re.search(rf"graph\.npz: {expected}.*; the map is used without keyframes", saved.grid.remarks[0])


@pytest.mark.parametrize("kind", ["PNG", "PPM", "BMP", "JPEG", "TIFF", "GIF", "WEBP"])
def test_a_damaged_picture_of_any_format_is_read_or_refused_by_name(loose: dict[str, bytes], tmp_path: Path, kind: str):
    rng, out = random.Random(kind), io.BytesIO()
    Image.fromarray(np.random.default_rng(1).integers(0, 255, (40, 50), np.uint8)).save(out, kind)
    (tmp_path / "map.yaml").write_bytes(loose["map.yaml"])
    for _ in range(60):
        (tmp_path / "map.png").write_bytes(damaged(out.getvalue(), rng))
        assert "map.yaml: image: " in (refusal(storage.load, tmp_path) or "map.yaml: image: ")
