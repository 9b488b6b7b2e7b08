"""Map files: round trip, all keys, and errors that name file and key."""

import math

import numpy as np
import pytest
from PIL import Image

from monstertruck_runtime import map_files
from monstertruck_runtime.errors import InputError
from monstertruck_runtime.map_files import FREE, OCCUPIED, UNKNOWN, WorldMap, load_map, pixels, save_map, turned
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
    assert world.cells.tolist() == [[FREE, OCCUPIED, 30, UNKNOWN]]


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
        ({"resolution": 10**400}, "resolution"),
        ({"resolution": float("inf")}, "resolution"),
        ({"origin": [0, 0]}, "origin"),
        ({"negate": 2}, "negate"),
        ({"occupied_thresh": 65}, "occupied_thresh"),
        ({"free_thresh": 0.7}, "free_thresh"),
        ({"mode": "colour"}, "mode"),
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


def map_server(channels, alpha, mode, negate=0, occupied=0.65, free=0.196):
    """What nav2's map_server publishes for one pixel: channels in 0..1, alpha or None."""
    counted = [*channels, alpha] if mode == "trinary" and alpha is not None else channels
    shade = sum(counted) / len(counted)
    occ = shade if negate else 1.0 - shade
    if mode == "raw":
        percent = math.floor(shade * 255 + 0.5)
        return percent if percent <= 100 else -1
    if mode == "scale" and alpha is not None and alpha < 1:
        return -1
    if occ > occupied:
        return 100
    if occ < free:
        return 0
    return -1 if mode == "trinary" else round((occ - free) / (occupied - free) * 100)


GREYS = (0, 1, 40, 89, 90, 100, 127, 128, 150, 204, 205, 206, 254, 255)
COLOURS = ((0, 0, 0), (255, 255, 255), (200, 40, 10), (90, 100, 210), (205, 205, 205))
DEEP = (0, 1, 255, 256, 300, 13107, 22937, 22938, 32768, 52000, 53000, 65534, 65535)


def picture(mode):
    """A picture of a mode, the format that holds it, and channels in 0..1 and alpha of each of its pixels."""
    grey = np.array([GREYS], np.uint8)
    opaque = [([v / 255] * 3, None) for v in GREYS]
    match mode:
        case "1":
            return Image.fromarray(grey > 127).convert("1"), "png", [([float(v > 127)] * 3, None) for v in GREYS]
        case "L":
            return Image.fromarray(grey), "pgm", opaque
        case "LA":
            levels = np.stack((grey, grey[:, ::-1]), axis=-1)
            values = [([v / 255] * 3, a / 255) for v, a in zip(GREYS, GREYS[::-1], strict=True)]
            return Image.fromarray(levels, "LA"), "png", values
        case "P":
            return Image.fromarray(grey).convert("P"), "gif", opaque
        case "RGB":
            return (
                Image.fromarray(np.array([COLOURS], np.uint8)),
                "bmp",
                [([c / 255 for c in v], None) for v in COLOURS],
            )
        case "RGBA":
            levels = np.array([[(*v, 60 * i) for i, v in enumerate(COLOURS)]], np.uint8)
            values = [([c / 255 for c in v], 60 * i / 255) for i, v in enumerate(COLOURS)]
            return Image.fromarray(levels), "png", values
        case "CMYK":
            levels = np.stack([grey * 0] * 3 + [255 - grey], axis=-1)
            return Image.fromarray(levels, "CMYK"), "tiff", opaque
        case "I;16":
            return Image.fromarray(np.array([DEEP], np.uint16)), "png", [([v / 65535] * 3, None) for v in DEEP]
        case "I;16B":
            levels = np.array([DEEP], ">u2")
            image = Image.frombytes("I;16B", levels.shape[::-1], levels.tobytes())
            return image, "tiff", [([v / 65535] * 3, None) for v in DEEP]
        case "I":
            levels = np.array([DEEP], np.int32) * 32768
            return Image.fromarray(levels), "tiff", [([v * 32768 / (2**31 - 1)] * 3, None) for v in DEEP]
        case "F":
            levels = np.array([GREYS], np.float32) / 255
            return Image.fromarray(levels), "tiff", [([float(v)] * 3, None) for v in levels[0]]
    raise AssertionError(mode)


@pytest.mark.parametrize("negate", [0, 1])
@pytest.mark.parametrize("rule", ["trinary", "scale", "raw"])
@pytest.mark.parametrize("mode", ["1", "L", "LA", "P", "RGB", "RGBA", "CMYK", "I;16", "I;16B", "I", "F"])
def test_every_kind_of_picture_by_the_rules_of_map_server(tmp_path, mode, rule, negate):
    image, suffix, values = picture(mode)
    image.save(tmp_path / f"m.{suffix}")
    path = tmp_path / "m.yaml"
    path.write_text(yaml_text(KEYS | {"image": f"m.{suffix}", "mode": rule, "negate": negate}))
    assert load_map(path).cells.tolist() == [[map_server(*value, rule, negate) for value in values]]


@pytest.mark.parametrize("mode", ["YCbCr", "LAB", "HSV", "PA", "RGBX", "RGBa", "La", "I;16L", "I;16N"])
def test_the_other_modes_of_pillow_keep_black_and_white(mode):
    black_white = Image.fromarray(np.array([[0, 255]], np.uint8))
    if mode == "LAB":
        image = Image.frombytes("LAB", (2, 1), bytes((0, 0, 0, 255, 0, 0)))
    elif mode.startswith("I;16"):
        image = Image.frombytes(mode, (2, 1), np.array([0, 65535], "<u2").tobytes())
    else:
        image = black_white.convert("RGBA" if mode in ("RGBa", "PA") else "LA" if mode == "La" else "RGB").convert(mode)
    shades, _ = pixels(image)
    levels = shades.levels.astype(float).reshape(2, -1).mean(axis=1) / shades.full
    assert levels == pytest.approx([0.0, 1.0], abs=0.02)


def test_sixteen_bits_hold_the_same_walls_as_eight(tmp_path):
    shades = np.random.default_rng(2).choice([0, 120, 205, 254], size=(30, 40)).astype(np.uint8)
    Image.fromarray(shades.astype(np.uint16) * 257).save(tmp_path / "deep.png")
    eight = load_map(write(tmp_path, shades))
    (tmp_path / "deep.yaml").write_text(yaml_text(KEYS | {"image": "deep.png"}))
    np.testing.assert_array_equal(load_map(tmp_path / "deep.yaml").cells, eight.cells)
    assert (eight.cells == OCCUPIED).any()


def test_a_tiff_whose_white_is_zero_and_a_transparent_level_of_sixteen_bits(tmp_path):
    levels = np.array([[0, 65535]], np.uint16)
    inverted = Image.fromarray(65535 - levels)
    inverted.save(tmp_path / "m.tiff", tiffinfo={262: 0})
    path = tmp_path / "m.yaml"
    path.write_text(yaml_text(KEYS | {"image": "m.tiff"}))
    with Image.open(tmp_path / "m.tiff") as image:
        shades, _ = pixels(image)
    assert (shades.levels / shades.full).tolist() == [[0.0, 1.0]]
    image = Image.fromarray(levels)
    image.info["transparency"] = 65535
    assert pixels(image)[1].tolist() == [[255, 0]]


def test_numbers_that_are_no_shades_are_refused(tmp_path):
    Image.fromarray(np.array([[0.0, 255.0]], np.float32)).save(tmp_path / "m.tiff")
    path = tmp_path / "m.yaml"
    path.write_text(yaml_text(KEYS | {"image": "m.tiff"}))
    with pytest.raises(InputError, match="levels 0 to 255, expected 0 to 1"):
        load_map(path)


@pytest.mark.parametrize("size", [(8000, 8000), (20000, 20000)])
def test_a_picture_that_unpacks_to_too_much_is_refused_unread(tmp_path, monkeypatch, size):
    Image.new("1", size).save(tmp_path / "m.png")
    monkeypatch.setattr(map_files, "pixels", lambda _: pytest.fail("decoded"))
    path = tmp_path / "m.yaml"
    path.write_text(yaml_text(KEYS))
    with pytest.raises(InputError, match=r"m\.yaml: image: .*pixels"):
        load_map(path)


@pytest.mark.parametrize("cut", [20, 60, 900])
def test_damaged_pictures_are_refused_by_name(tmp_path, cut):
    shades = np.random.default_rng(3).integers(0, 255, (40, 40))
    path = write(tmp_path, shades)
    data = bytearray((tmp_path / "m.png").read_bytes())
    data[cut] ^= 0xFF
    (tmp_path / "m.png").write_bytes(data[: cut + 10] if cut > 0 else data[:cut])
    with pytest.raises(InputError, match=r"m\.yaml: image: .*m\.png"):
        load_map(path)


def test_an_image_is_looked_for_beside_its_yaml_and_at_home(tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    (tmp_path / "home" / "maps").mkdir(parents=True)
    path = write(tmp_path, [[0]])
    for name in ("/nowhere/m.png", "~/maps/m.png", str(tmp_path / "m.png")):
        path.write_text(yaml_text(KEYS | {"image": name}))
        assert load_map(path).cells.tolist() == [[OCCUPIED]], name
    Image.fromarray(np.array([[255]], np.uint8)).save(tmp_path / "home" / "maps" / "m.png")
    path.write_text(yaml_text(KEYS | {"image": "~/maps/m.png"}))
    assert load_map(path).cells.tolist() == [[FREE]], "the one it names, where it is there"


def test_unknown_keys_are_kept_and_remarked_on(tmp_path):
    world = load_map(write(tmp_path, [[0]], floor=3))
    assert [f"{tmp_path / 'm.yaml'}: floor: unknown key, left unchanged"] == list(world.remarks)
    save_map(world, tmp_path / "again.yaml")
    assert load_map(tmp_path / "again.yaml").others == {"floor": 3}


def test_a_map_without_a_wall_is_remarked_on(tmp_path):
    (remark,) = load_map(write(tmp_path, [[255, 205]])).remarks
    assert "no occupied cell" in remark
    assert load_map(write(tmp_path, [[255, 0]])).remarks == ()


@pytest.mark.parametrize("yaw", [math.pi / 2, -math.pi / 2, math.pi, 0.5, -2.2])
def test_a_turned_origin_puts_every_cell_where_map_server_does(tmp_path, yaw):
    shades = np.full((40, 60), 254)
    shades[10:12, 5:50] = 0
    shades[10:35, 40] = 0
    straight = load_map(write(tmp_path, shades, origin=[1.0, -2.0, 0.0]))
    world = load_map(write(tmp_path, shades, origin=[1.0, -2.0, yaw]))
    row, column = np.nonzero(straight.cells >= 0)
    local = (np.column_stack((column, row)) + 0.5) * 0.1
    turn = np.array(((math.cos(yaw), math.sin(yaw)), (-math.sin(yaw), math.cos(yaw))))
    x, y = np.floor((local @ turn + (1.0, -2.0) - world.origin) / 0.1 + 1e-9).astype(int).T
    there = world.cells[y, x]
    assert (there[straight.cells[row, column] == OCCUPIED] == OCCUPIED).all(), "no wall is lost"
    assert (there == straight.cells[row, column]).mean() > 0.95
    ratio = (world.cells == OCCUPIED).sum() / (straight.cells == OCCUPIED).sum()
    assert ratio == 1.0 if yaw in (math.pi / 2, -math.pi / 2, math.pi) else 1.0 <= ratio < 1.6


def test_a_turned_map_that_grows_too_large_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(map_files, "MOST_CELLS", 100)
    with pytest.raises(InputError, match=r"m\.yaml: origin: 15 x 15 cells along"):
        load_map(write(tmp_path, np.zeros((10, 10)), origin=[0.0, 0.0, 0.7]))


def test_a_map_of_percents_becomes_trinary():
    world = WorldMap(np.array([[0, 19, 20, 64, 65, 100, -1]]), 0.1)
    assert world.trinary().cells.tolist() == [[0, 0, -1, -1, 100, 100, -1]]
    assert turned(world.cells, 0.1, (0.0, 0.0, 0.0))[0].tolist() == world.cells.tolist()


def test_a_yaml_never_names_the_picture_of_another_map(tmp_path, monkeypatch):
    old, new = (WorldMap(np.full((3, 4), value), 0.1, (float(value), 0.0)) for value in (FREE, OCCUPIED))
    path = tmp_path / "hall.yaml"
    (tmp_path / "hall-mine.png").write_bytes(b"mine")
    save_map(old, path)
    write_file, steps = map_files.replace_file, []

    def step(file, content):
        world = load_map(path)
        assert world.origin == (float(world.cells[0, 0]), 0.0), "of one map at every moment"
        write_file(file, content)
        steps.append(file.name)

    monkeypatch.setattr(map_files, "replace_file", step)
    for world in (new, new, old):
        save_map(world, path)
        assert load_map(path).cells.tolist() == world.cells.tolist()
        assert len(list(tmp_path.iterdir())) == 3, "the former picture is gone, other files stay"
    first, second, third = steps[::2]
    assert steps[1::2] == ["hall.yaml"] * 3
    assert second == "hall.png"
    assert first != third
    monkeypatch.undo()
    path.write_text(yaml_text(KEYS | {"image": "hall-mine.png"}))
    save_map(new, path)
    assert (tmp_path / "hall-mine.png").exists(), "a picture of the user's"
