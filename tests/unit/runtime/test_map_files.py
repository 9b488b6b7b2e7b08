"""Map files: round trip, all keys, and errors that name file and key."""

import numpy as np
import pytest
from PIL import Image

from monstertruck_runtime.errors import InputError
from monstertruck_runtime.map_files import FREE, OCCUPIED, UNKNOWN, WorldMap, load_map, save_map
from monstertruck_runtime.yaml_files import yaml_text

KEYS = {
    "image": "m.png",
    "resolution": 0.1,
    "origin": [-1.0, 2.0, 0.0],
    "negate": 0,
    "occupied_thresh": 0.65,
    "free_thresh": 0.196,
}


def write(folder, shades, **changes):
    Image.fromarray(np.array(shades, dtype=np.uint8)).save(folder / "m.png")
    keys = {key: value for key, value in (KEYS | changes).items() if value is not None}
    path = folder / "m.yaml"
    path.write_text(yaml_text(keys))
    return path


def test_round_trip(tmp_path):
    cells = np.random.default_rng(1).choice([FREE, OCCUPIED, UNKNOWN], size=(5, 7))
    save_map(WorldMap(cells, 0.05, (-2.5, 1.0)), tmp_path / "a.yaml")
    back = load_map(tmp_path / "a.yaml")
    np.testing.assert_array_equal(back.cells, cells)
    assert (back.resolution, back.origin, back.size) == (0.05, (-2.5, 1.0), (7 * 0.05, 0.25))
    assert not back.cells.flags.writeable


def test_row_zero_is_the_lowest_y(tmp_path):
    world = load_map(write(tmp_path, [[0, 255], [255, 205]]))
    assert world.cells.tolist() == [[FREE, UNKNOWN], [OCCUPIED, FREE]]


def test_negate_swaps_black_and_white(tmp_path):
    world = load_map(write(tmp_path, [[0, 255]], negate=1))
    assert world.cells.tolist() == [[FREE, OCCUPIED]]


def test_raw_takes_percent(tmp_path):
    world = load_map(write(tmp_path, [[0, 100, 30, 255]], mode="raw"))
    assert world.cells.tolist() == [[FREE, OCCUPIED, UNKNOWN, UNKNOWN]]


def test_scale_knows_transparent_from_white(tmp_path):
    world = load_map(write(tmp_path, [[[255, 255, 255, 0], [255, 255, 255, 255]]], mode="scale"))
    assert world.cells.tolist() == [[UNKNOWN, FREE]]


@pytest.mark.parametrize(
    ("changes", "key"),
    [
        ({"image": None}, "image"),
        ({"image": "none.png"}, "image"),
        ({"image": "m.yaml"}, "image"),
        ({"image": 3}, "image"),
        ({"resolution": 0}, "resolution"),
        ({"resolution": "fine"}, "resolution"),
        ({"origin": [0, 0]}, "origin"),
        ({"origin": [0, 0, 0.5]}, "origin"),
        ({"negate": 2}, "negate"),
        ({"occupied_thresh": 65}, "occupied_thresh"),
        ({"free_thresh": 0.7}, "free_thresh"),
        ({"mode": "colour"}, "mode"),
        ({"resolutoin": 1}, "resolutoin"),
    ],
)
def test_errors_name_file_and_key(tmp_path, changes, key):
    path = write(tmp_path, [[0]], **changes)
    with pytest.raises(InputError, match=rf"m\.yaml: {key}: "):
        load_map(path)


@pytest.mark.parametrize("text", ["- 1\n", "a: [\n", None])
def test_hopeless_files(tmp_path, text):
    path = tmp_path / "m.yaml"
    if text is not None:
        path.write_text(text)
    with pytest.raises(InputError, match=r"m\.yaml"):
        load_map(path)
