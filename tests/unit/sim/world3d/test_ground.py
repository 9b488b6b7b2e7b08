"""Ground: every feature has the heights it says, stones and steps stand on it, other files' geometries are in it."""

from math import atan, degrees, pi, radians, tan
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from monstertruck_runtime.errors import CommandFailedError, InputError
from monstertruck_sim.world.config import SonarModelConfig, WorldConfig
from monstertruck_sim.world.terrain import Profile
from monstertruck_sim.world.world import World
from monstertruck_sim.world3d.ground import blocks, ground_heights, scenery
from monstertruckd.tools.simulation.config import load_simulated

BOUNDS = (-5.0, 5.0, -4.0, 4.0)
ORIGIN = (0.0, 0.0, 0.0)
WORLDS = Path(__file__).parents[4] / "configs" / "world3d"


def configured(*features, **config):
    return WorldConfig.model_validate({"engine": "mujoco", "ground": list(features), **config})


def heights(*features, profile=None, **config):
    return ground_heights(configured(*features, **config), profile, BOUNDS, [ORIGIN])


def at(grid, *places):
    x, y = np.array(places, float).T
    return grid.height(x, y)


def test_level_ground_has_no_heights_and_stones_change_none():
    assert heights() is None
    assert heights({"kind": "step", "x": 1.0, "y": 0.0}, {"kind": "rubble"}) is None


def test_a_slope_rises_between_two_levels():
    grid = heights({"kind": "slope", "x": 1.0, "y": 0.0, "direction": pi / 2, "angle_deg": 10.0, "length": 2.0})
    expected = [0.0, tan(radians(10)), 2 * tan(radians(10)), 2 * tan(radians(10))]
    assert at(grid, (0, -1), (0, 1), (3, 2), (0, 3.5)) == pytest.approx(expected, abs=1e-9)


def test_a_ditch_has_a_flat_bottom_sides_and_ends():
    grid = heights({"kind": "ditch", "x": 1.0, "y": 0.0, "yaw": pi / 2, "length": 4.0, "width": 0.8, "depth": 0.1})
    found = at(grid, (1.0, 0.0), (1.15, 0.0), (1.3, 0.0), (1.45, 0.0), (1.0, 2.5), (1.0, 1.0))
    assert found == pytest.approx([-0.1, -0.1, -0.05, 0.0, 0.0, -0.1], abs=1e-9)


def test_hills_are_drawn_by_their_seed_and_level_at_the_start():
    one = heights({"kind": "hills", "height": 0.05, "wavelength": 1.0, "seed": 1, "flat": 0.6})
    same = heights({"kind": "hills", "height": 0.05, "wavelength": 1.0, "seed": 1, "flat": 0.6})
    other = heights({"kind": "hills", "height": 0.05, "wavelength": 1.0, "seed": 2, "flat": 0.6})
    assert (one.z == same.z).all()
    assert not (one.z == other.z).all()
    assert 0.03 < one.z.std() < 0.06
    assert at(one, (0.0, 0.0), (0.4, -0.3)) == pytest.approx([0.0, 0.0], abs=1e-9)
    assert abs(np.diff(one.z, axis=1)).max() < 0.05  # no wave shorter than a metre


def test_features_profile_and_rough_patches_add_up():
    rough = {"x": 0.0, "y": 0.0, "length": 8.0, "width": 8.0, "height": 0.1, "wavelength": 4.0}
    grid = heights(
        {"kind": "slope", "angle_deg": 45 / 2, "length": 4.0},
        profile=Profile(((0.0, 0.0), (4.0, 0.4))),
        rough=[rough],
    )
    assert at(grid, (1.0, 0.0))[0] == pytest.approx(tan(radians(22.5)) + 0.1 + 0.05, abs=1e-6)


@pytest.mark.parametrize(("dtype", "white"), [(np.uint8, 255), (np.uint16, 65535)])
def test_a_pictures_upper_row_is_its_far_side(tmp_path, dtype, white):
    pixels = np.zeros((3, 4), dtype)
    pixels[0, 1] = white
    Image.fromarray(pixels).save(tmp_path / "hill.png")
    image = {"file": tmp_path / "hill.png", "resolution": 0.5, "height": 0.3, "x": -1.0, "y": 0.0}
    grid = heights(height_image=image)
    assert at(grid, (-0.5, 1.0), (-0.5, 0.0), (-1.0, 1.0)) == pytest.approx([0.3, 0.0, 0.0])


def test_what_is_no_picture_is_refused(tmp_path):
    (tmp_path / "hill.png").write_text("no picture")
    with pytest.raises(InputError, match=r"hill\.png: expected a height image \(sim\.world\.height_image\)"):
        heights(height_image={"file": tmp_path / "hill.png"})


def test_a_picture_that_would_fill_the_memory_is_refused(tmp_path, monkeypatch):
    Image.fromarray(np.zeros((3, 4), np.uint8)).save(tmp_path / "hill.png")
    monkeypatch.setattr(Image, "MAX_IMAGE_PIXELS", 5)
    with pytest.raises(InputError, match=r"hill\.png: Image size \(12 pixels\): expected at most"):
        heights(height_image={"file": tmp_path / "hill.png"})


def test_steps_stand_on_the_ground_with_their_height():
    config = configured(
        {"kind": "slope", "x": 0.0, "angle_deg": 10.0, "length": 2.0},
        {"kind": "step", "x": 1.0, "y": 0.5, "yaw": 0.3, "length": 0.2, "width": 0.8, "height": 0.03},
    )
    grid = ground_heights(config, None, BOUNDS, [ORIGIN])
    (step,) = blocks(config.ground, grid)
    assert step.z + step.height / 2 == pytest.approx(tan(radians(10)) + 0.03, abs=1e-6)
    assert (step.x, step.y, step.yaw, step.length, step.width) == (1.0, 0.5, 0.3, 0.2, 0.8)


def test_rubble_stays_in_its_rectangle_and_below_its_height():
    config = configured(
        {"kind": "rubble", "x": 2.0, "y": 1.0, "length": 3.0, "width": 1.0, "count": 50, "height": 0.04}
    )
    stones = blocks(config.ground, None)
    assert len(stones) == 50
    assert all(abs(stone.x - 2.0) <= 1.5 and abs(stone.y - 1.0) <= 0.5 for stone in stones)
    assert all(stone.z + stone.height / 2 <= 0.04 + 1e-9 for stone in stones)
    assert blocks(config.ground, None) == stones


def scene_file(tmp_path, body):
    file = tmp_path / "scene.xml"
    file.write_text(f"<mujoco><worldbody>{body}</worldbody></mujoco>")
    return file


def test_geometries_of_another_file_are_seen_and_touched(tmp_path):
    file = scene_file(tmp_path, '<body pos="1.2 0 0.3"><geom type="box" size="0.1 1 0.3"/></body>')
    config = configured(map="yard", noise=False, mjcf=file, start={"x": 0.0, "y": 0.0, "yaw": 0.0})
    world = World(config, 1)
    assert world.lidar.scan(0)[384] == pytest.approx(1100 - 140, abs=1)
    world.sonars.fire("f", 0)
    assert world.sonars.range("f") == pytest.approx(1.1 - 0.12, abs=0.005)
    world.motors[0].command(0, -16_000.0, 20_000.0)
    assert world.truth(9_000_000_000).x == pytest.approx(1.1 - 0.235, abs=0.02)


def test_a_sonar_that_leans_looks_over_a_low_thing(tmp_path, solid):
    """0.15 m high, 1.6 m ahead: a sonar 0.12 m over the ground meets it, nose up by 5 degrees it does not."""
    heard = []
    for angle in (0.0, 5.0):
        rise = ({"kind": "slope", "x": -1.0, "angle_deg": angle, "length": 1.2},) if angle else ()
        middle = 0.075 + 1.2 * tan(radians(angle))
        file = scene_file(tmp_path, f'<geom type="box" pos="1.7 0 {middle}" size="0.1 1 0.075"/>')
        driver = solid(mjcf=file, start=(0.0, 0.0, 0.0), sonar=SonarModelConfig(model="beam"), ground=rise)
        driver.world.sonars.fire("f", driver.now)
        heard.append(driver.world.sonars.range("f"))
    assert heard == [pytest.approx(1.6 - 0.12, abs=0.005), np.inf]


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        (
            "<mujoco><worldbody><body><joint/><geom size='1'/></body></worldbody></mujoco>",
            "<joint>: expected static geometries",
        ),
        ("<robot/>", "expected <mujoco>, found <robot>"),
        ("<mujoco>", "no element found"),
        ("<mujoco><worldbody><geom size='-1'/></worldbody></mujoco>", "MuJoCo refuses the model"),
    ],
)
def test_other_files_that_do_not_fit_are_refused(tmp_path, text, reason):
    file = tmp_path / "scene.xml"
    file.write_text(text)
    with pytest.raises(InputError, match=reason):
        World(configured(map="yard", mjcf=file), 1)


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        ("<default><geom type='box'/></default>", "<default>: expected geometries with all"),
        ("<compiler eulerseq='zyx'/>", "eulerseq zyx: expected xyz"),
        ("<worldbody><body><flexcomp name='f'/></body></worldbody>", "<flexcomp>: expected static geometries"),
        ("<worldbody><geom euler='0 0 north'/></worldbody>", "euler '0 0 north': expected numbers"),
    ],
)
def test_what_would_be_taken_for_something_else_is_refused(tmp_path, content, reason):
    (tmp_path / "scene.xml").write_text(f"<mujoco>{content}</mujoco>")
    with pytest.raises(InputError, match=reason):
        scenery(tmp_path / "scene.xml")


@pytest.mark.parametrize(("compiler", "turn"), [("", pi / 2), ('<compiler angle="radian"/>', 90.0)])
def test_angles_of_another_file_are_degrees_unless_it_says_otherwise(tmp_path, compiler, turn):
    body = '<body euler="0 0 90"><geom axisangle="0 1 0 90"/></body>'
    (tmp_path / "scene.xml").write_text(f"<mujoco>{compiler}<worldbody>{body}</worldbody></mujoco>")
    (found,) = scenery(tmp_path / "scene.xml")[1]
    assert [float(word) for word in found.get("euler").split()] == [0.0, 0.0, turn]
    assert [float(word) for word in found.find("geom").get("axisangle").split()] == [0.0, 1.0, 0.0, turn]


def test_files_of_assets_lie_where_the_compiler_says(tmp_path):
    compiler = '<compiler meshdir="shapes" assetdir="all"/>'
    assets = '<asset><mesh name="a" file="a.stl"/><texture name="b" type="2d" file="b.png"/></asset>'
    (tmp_path / "scene.xml").write_text(f"<mujoco>{compiler}{assets}</mujoco>")
    found = [asset.get("file") for asset in scenery(tmp_path / "scene.xml")[0]]
    assert found == [str(tmp_path / "shapes/a.stl"), str(tmp_path / "all/b.png")]


@pytest.mark.parametrize("place", ["0 0 0", "nan 0 0"])
def test_a_robot_that_begins_inside_of_something_is_refused(tmp_path, place, monkeypatch):
    monkeypatch.chdir(tmp_path)
    file = scene_file(tmp_path, f'<geom type="box" size="20 20 5" pos="{place}"/>')
    with pytest.raises(InputError, match=r"does not come to rest at \(0\.00, 0\.00\)"):
        World(configured(map="yard", noise=False, mjcf=file, start={"x": 0.0, "y": 0.0, "yaw": 0.0}), 1)
    assert not (tmp_path / "MUJOCO_LOG.TXT").exists()


def test_a_robot_is_not_carried_into_something(tmp_path):
    file = scene_file(tmp_path, '<geom type="box" size="0.4 0.4 1" pos="1.5 0 0"/>')
    world = World(configured(map="yard", noise=False, mjcf=file, start={"x": 0.0, "y": 0.0, "yaw": 0.0}), 1)
    with pytest.raises(InputError, match=r"does not come to rest at \(1\.50, 0\.00\)"):
        world.carry(0, (1.5, 0.0, 0.0))
    where = world.truth(1_000_000_000)
    assert (where.x, where.y) == pytest.approx((0.0, 0.0), abs=0.02)


def test_more_people_than_there_are_bodies_for_are_refused():
    with pytest.raises(InputError, match=r"sim\.world\.people: 25: expected at most 24"):
        World(configured(map="yard", noise=False, people=[{"radius": 0.05}] * 25), 1)


def test_numbers_beyond_all_bounds_end_the_simulation_instead_of_moving_the_robot(solid):
    driver = solid()
    driver.world.plant.data.qvel[0] = np.nan
    with pytest.raises(CommandFailedError, match="became unstable"):
        driver.world.truth(driver.now + 100_000_000)


def test_a_file_that_is_not_there_is_refused(tmp_path):
    with pytest.raises(InputError, match="nothing"):
        scenery(tmp_path / "nothing.xml")


@pytest.mark.parametrize("key", ["ground", "mjcf", "height_image"])
def test_the_plane_has_none_of_it(key):
    value = {"ground": [{"kind": "hills"}], "mjcf": Path("a.xml"), "height_image": {"file": Path("a.png")}}[key]
    with pytest.raises(ValueError, match="engine plane: has no ground"):
        WorldConfig.model_validate({key: value})


@pytest.mark.parametrize("name", sorted(path.stem for path in WORLDS.glob("*.yaml")))
def test_shipped_worlds_hold_the_truck(name):
    config = load_simulated(WORLDS / f"{name}.yaml").sim
    world = World(config.world, config.seed)
    truth = world.truth(0)
    slope = radians(12.0) if name == "side_slope" else 0.0
    assert truth.roll == pytest.approx(slope * 1.2, abs=max(0.25 * slope, 0.01))
    assert (world.lidar.scan(0) >= 20).mean() > 0.5


def test_the_body_follows_a_slope_and_its_lidar_sees_the_ground(solid):
    driver = solid(ground=({"kind": "slope", "x": -6.0, "angle_deg": 10.0, "length": 12.0},))
    truth = driver.world.truth(driver.now)
    assert degrees(truth.pitch) == pytest.approx(-10.0, abs=0.8)
    flat = solid(ground=({"kind": "slope", "x": 1.0, "angle_deg": 20.0, "length": 3.0},))
    seen = flat.world.lidar.scan(flat.now)[384] / 1000
    assert seen == pytest.approx(1.0 + 0.25 / tan(radians(20)) - 0.14, abs=0.01)


def test_wheels_climb_a_kerb_and_the_clutch_slips_at_a_high_one(solid):
    driver = solid(ground=({"kind": "step", "x": 1.5, "y": 0.0, "length": 1.5, "width": 3.0, "height": 0.012},))
    driver.drive(0.2)
    driver.wait(5.0)
    truth = driver.wait(3.0)
    assert truth.x > 1.2
    assert driver.world._plant.height == pytest.approx(0.012, abs=0.003)
    assert not truth.stuck
    high = solid(ground=({"kind": "step", "x": 1.5, "y": 0.0, "length": 1.5, "width": 3.0, "height": 0.04},))
    high.drive(0.2)
    assert high.wait(8.0).clutch_slipping


def test_the_lidar_sees_a_step_of_its_own_height(solid):
    driver = solid(ground=({"kind": "step", "x": 2.0, "y": 0.0, "length": 0.2, "width": 6.0, "height": 0.4},))
    scan = driver.world.lidar.scan(driver.now) / 1000
    for step in (384, 300, 420):
        angle = (step - 384) * 2 * pi / 1024
        assert scan[step] == pytest.approx((1.9 - 0.14) / np.cos(angle), abs=0.002)


def test_a_height_of_a_start_pose_is_the_grounds(solid):
    driver = solid(
        start=(3.0, 0.0, 0.0), ground=({"kind": "slope", "x": 0.0, "angle_deg": degrees(atan(0.1)), "length": 2.0},)
    )
    assert driver.world._plant.height == pytest.approx(0.2, abs=0.002)
    driver.world.carry(driver.now, (-2.0, 0.0, 0.0))
    assert driver.world._plant.height == pytest.approx(0.0, abs=0.002)
    assert driver.world.truth(driver.now).x == pytest.approx(-2.0, abs=0.01)
