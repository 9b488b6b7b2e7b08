"""Our own worlds: committed files equal the drawings, the lap is drivable, profiles tilt the truck."""

from math import cos, hypot, pi, radians, sin
from pathlib import Path

import numpy as np
import pytest
from pydantic import ValidationError
from scipy.ndimage import distance_transform_edt, label

from monstertruck_runtime.errors import InputError
from monstertruck_runtime.map_files import FREE, OCCUPIED, load_map
from monstertruck_schemas.base import Pose2D
from monstertruck_sim.world.built_in import BUILT_IN, CIRCUIT, lap, make_worlds
from monstertruck_sim.world.config import LidarConfig, RoughPatch, ServoModelConfig, SimTruckConfig, WorldConfig
from monstertruck_sim.world.obstacles import Box, Disc, penetration
from monstertruck_sim.world.terrain import LEVEL, Profile, Terrain, load_profile
from monstertruck_sim.world.world import World

CONFIGS = Path(__file__).parents[4] / "configs"


def test_committed_files_are_what_the_script_writes(tmp_path):
    written = make_worlds(tmp_path)
    assert {path.name for path in written} >= {"loop.yaml", "loop.png", "ramp.profile.yaml", "loop.csv"}
    for path in written:
        committed = CONFIGS / path.relative_to(tmp_path)
        if path.suffix == ".yaml" and "profile" not in path.name:
            np.testing.assert_array_equal(load_map(committed).cells, load_map(path).cells)
        if path.suffix != ".png":  # compression differs between libraries; the cells above do not
            assert committed.read_text() == path.read_text()


@pytest.mark.parametrize("name", BUILT_IN)
def test_worlds_are_closed_connected_and_hold_the_truck(name):
    built = BUILT_IN[name]()
    cells = built.map.cells
    assert label(cells == FREE)[1] == 1
    # What is not wall falls apart into inside and outside: nothing free touches the unknown.
    regions, _ = label(cells != OCCUPIED)
    assert not set(np.unique(regions[cells == FREE])) & set(np.unique(regions[cells == -1]))
    World(WorldConfig(map=name), seed=0)


def test_lap_is_closed_even_and_clear_of_walls():
    points = lap()
    np.testing.assert_array_equal(points[0], points[-1])
    np.testing.assert_array_equal(points[0], BUILT_IN["loop"]().start)
    gaps = np.hypot(*np.diff(points[:, :2], axis=0).T)
    assert gaps.sum() == pytest.approx(16 - 8 + 2 * pi, abs=0.01)
    np.testing.assert_allclose(gaps, 0.05, atol=2e-4)
    turns = (np.diff(points[:, 2]) + pi) % (2 * pi) - pi
    assert np.abs(turns / gaps).max() <= 1 / 0.99
    assert turns.sum() == pytest.approx(2 * pi)
    along = np.arctan2(*np.diff(points[:, :2], axis=0).T[::-1])
    assert np.abs((along - points[:-1, 2] - turns / 2 + pi) % (2 * pi) - pi).max() < 0.01
    world = BUILT_IN["loop"]().map
    clearance = distance_transform_edt(world.cells != OCCUPIED) * world.resolution
    columns, rows = ((points[:, :2] - world.origin) / world.resolution).astype(int).T
    assert clearance[rows, columns].min() > 0.45


def test_the_circuit_is_wide_enough_for_a_fast_robot():
    points = lap(CIRCUIT)
    np.testing.assert_array_equal(points[0], BUILT_IN["circuit"]().start)
    gaps = np.hypot(*np.diff(points[:, :2], axis=0).T)
    assert gaps.sum() == pytest.approx(2 * (9.0 - 5.0) + 2 * (6.4 - 5.0) + 5 * pi, abs=0.01)
    turns = (np.diff(points[:, 2]) + pi) % (2 * pi) - pi
    assert np.abs(turns / gaps).max() <= 1 / 2.49
    world = BUILT_IN["circuit"]().map
    clearance = distance_transform_edt(world.cells != OCCUPIED) * world.resolution
    columns, rows = ((points[:, :2] - world.origin) / world.resolution).astype(int).T
    assert clearance[rows, columns].min() > 0.7


def test_lap_file():
    lines = (CONFIGS / "paths" / "loop.csv").read_text().splitlines()
    assert lines[0] == "x,y,yaw,direction"
    np.testing.assert_allclose([[float(v) for v in line.split(",")[:3]] for line in lines[1:]], lap(), atol=1e-4)


def test_terrain_gives_pitch_and_roll_by_heading():
    slope = Terrain(Profile(((0.0, 0.0), (10.0, 10.0 * np.tan(radians(10))))), ())
    assert slope.tilt(5, 0, 0.0, 0.32, 0.26) == pytest.approx((-radians(10), 0.0))  # uphill: nose up
    assert slope.tilt(5, 0, pi, 0.32, 0.26) == pytest.approx((radians(10), 0.0))
    assert slope.tilt(5, 0, pi / 2, 0.32, 0.26) == pytest.approx((0.0, -radians(10)))  # left wheels lower
    assert slope.tilt(5, 0, -pi / 2, 0.32, 0.26) == pytest.approx((0.0, radians(10)))
    half = slope.tilt(0.0, 0, 0.0, 0.32, 0.26)[0]
    assert -radians(10) < half < 0


def test_a_rough_patch_tilts_the_truck_there_and_nowhere_else():
    rough = Terrain(LEVEL, (RoughPatch(x=2.0, y=0.0, length=1.0, width=0.8, height=0.02, wavelength=0.45),))
    xs = np.linspace(0.0, 4.0, 201)
    tilts = np.array([np.hypot(*rough.tilt(x, 0.1, 0.0, 0.32, 0.26)) for x in xs])
    on = abs(xs - 2.0) < 0.5 + 0.16
    assert tilts[on].max() > 0.05
    assert not tilts[~on].any()
    assert not any(rough.tilt(x, 1.0, 0.0, 0.32, 0.26) != (0.0, 0.0) for x in xs)


def test_beams_meet_the_ground_where_it_rises_to_them():
    slope = Terrain(Profile(((1.0, 0.0), (2.0, 0.5))), ())
    headings = np.array((0.0, 0.0, pi, pi / 3))
    rises = np.array((0.0, -0.1, 0.0, 0.0))
    met = slope.cast(np.zeros(4), np.zeros(4), np.full(4, 0.25), headings, rises, 5.6)
    assert met == pytest.approx((1.5, (0.25 + 0.5) / 0.6, np.inf, 1.5 / np.cos(pi / 3)), abs=1e-6)


def test_ramp_world_tilts_the_truck():
    start = Pose2D(x=1.75, y=0.0, yaw=0.0)
    for name in ("ramp", str(CONFIGS / "worlds" / "ramp.yaml")):
        truth = World(WorldConfig(map=name, start=start), seed=0).truth(0)
        assert truth.pitch == pytest.approx(-radians(8), abs=1e-3)
    assert World(WorldConfig(map="ramp"), seed=0).truth(0).pitch == 0


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ("points: [[0, 1]]", "two points"),
        ("points: [[1, 0], [0, 0]]", "increasing"),
        ("point: 3", "list of"),
        ("a: [", ":1: not valid YAML"),
    ],
)
def test_bad_profiles_are_refused(tmp_path, text, match):
    path = tmp_path / "x.profile.yaml"
    path.write_text(text)
    with pytest.raises(InputError, match=match):
        load_profile(path)


@pytest.mark.parametrize(
    ("config", "match"),
    [
        (WorldConfig(map="lopo"), "loop, rooms"),
        (WorldConfig(map="nowhere.yaml"), r"nowhere\.yaml"),
        (WorldConfig(map="loop", start=Pose2D(x=0.0, y=0.0, yaw=0.0)), "touches"),
        (WorldConfig(map="loop", start=Pose2D(x=2.95, y=0.3, yaw=0.0)), "touches"),
    ],
)
def test_bad_worlds_are_refused(config, match):
    with pytest.raises(InputError, match=match):
        World(config, seed=0)


@pytest.mark.parametrize(
    ("model", "values", "match"),
    [
        (SimTruckConfig, {"length": 0.3}, "wheelbase"),
        (SimTruckConfig, {"rear_servo": ServoModelConfig(channel=1)}, "share channel 1"),
        (LidarConfig, {"first_step": 700, "last_step": 44}, "first_step 700"),
        (LidarConfig, {"min_range": 6.0, "max_range": 5.6}, "min_range"),
        (WorldConfig, {"gravity": 1.6}, "gravity"),
    ],
)
def test_impossible_configurations_are_refused(model, values, match):
    with pytest.raises(ValidationError, match=match):
        model(**values)


def test_removing_what_is_not_there():
    with pytest.raises(InputError, match="not in the world"):
        World(WorldConfig(), seed=0).remove(0, Disc(0, 0, 1))


def test_obstacle_penetration_against_distance():
    body = Box(0, 0, 0.47, 0.34, yaw=0.4)
    for bearing in np.linspace(0, 2 * pi, 17):
        edge = 1.0
        while penetration(body, Disc(edge * cos(bearing), edge * sin(bearing), 0.1)) == 0:
            edge -= 0.001
        local = np.array([edge * cos(bearing - 0.4), edge * sin(bearing - 0.4)])
        outside = np.maximum(abs(local) - (0.235, 0.17), 0)
        assert hypot(*outside) == pytest.approx(0.1, abs=0.002)
    assert penetration(body, Box(0.1, 0.0, 0.1, 0.1)) > 0
    assert penetration(body, Box(0.4, 0.3, 0.1, 0.1, yaw=1.0)) == 0
