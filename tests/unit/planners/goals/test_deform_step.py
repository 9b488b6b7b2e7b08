"""The deforming step: free routes stay as they are, what stands on them is passed, and what cannot be is said."""

import math
from dataclasses import replace

import numpy as np
import pytest

from monstertruck_kinematics.truck import FourWheelSteering
from monstertruck_planners.collision import Footprint
from monstertruck_planners.goals.config import LocalConfig, PlannerConfig
from monstertruck_planners.goals.deform_step import DeformStep, blind_beams
from monstertruck_planners.goals.exchange import DeformAnswer, DeformTask, Setup
from monstertruck_planners.local.config import PeopleConfig, RsbandConfig
from monstertruck_planners.pose_path import PosePath
from monstertruck_runtime.clock import SECOND
from monstertruck_runtime.errors import InputError
from monstertruck_schemas.base import Pose2D
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.sensor import LaserScan
from monstertruck_schemas.state import Grid

HEAD = {"stamp": 5, "received": 5, "seq": 0}
ROUTE = np.column_stack((np.arange(0.0, 4.01, 0.05), np.zeros(81), np.zeros(81)))
ANGLES = np.radians(np.linspace(-120.0, 120.0, 481))
ORIGIN = (0.0, 0.0, 0.0)
Box = tuple[float, float, float, float]


def scan_of(pose: tuple[float, float, float], *boxes: Box) -> LaserScan:
    """What a lidar at the base sees of boxes x0, y0, x1, y1."""
    ranges = np.full(len(ANGLES), math.inf)
    course = ANGLES + pose[2]
    with np.errstate(divide="ignore", invalid="ignore"):
        for x0, y0, x1, y1 in boxes:
            sides = [
                np.sort(np.stack(((low - at) / step, (high - at) / step)), axis=0)
                for low, high, at, step in ((x0, x1, pose[0], np.cos(course)), (y0, y1, pose[1], np.sin(course)))
            ]
            enter, leave = np.fmax(sides[0][0], sides[1][0]), np.fmin(sides[0][1], sides[1][1])
            hit = (enter < leave) & (enter > 0.0) & (enter < 4.0)
            ranges = np.where(hit, np.minimum(ranges, enter), ranges)
    return LaserScan(
        **HEAD, frame="lidar", start_angle=ANGLES[0], end_angle=ANGLES[-1], time_increment=0.0, scan_time=0.1,
        range_min=0.02, range_max=4.1, ranges=ranges, codes=np.where(np.isfinite(ranges), 255, 0).astype(np.uint8),
    )  # fmt: skip


def room() -> Grid:
    cells = np.zeros((80, 120), np.int8)
    return Grid(
        **HEAD, frame="map", resolution=0.05, width=120, height=80, origin=Pose2D(x=-1.0, y=-2.0, yaw=0.0),
        cells=cells.ravel(),
    )  # fmt: skip


def begun(route: np.ndarray = ROUTE, directions: np.ndarray | None = None) -> tuple[DeformStep, DeformTask]:
    """A step, and its first task."""
    config = PlannerConfig(local_planner=RsbandConfig())
    setup = Setup(config, FourWheelSteering(), Footprint(), ORIGIN)
    way = PosePath(route, np.ones(len(route)) if directions is None else directions)
    return DeformStep(), DeformTask(scan_of(ORIGIN), ORIGIN, setup, room(), way, 1)


def drive(step: DeformStep, until: str, *boxes: Box) -> tuple[DeformAnswer, set[str], tuple[float, float, float]]:
    """Follow what the step says until it comes to a finding; also all findings, and where that was."""
    pose, path, found = ORIGIN, ROUTE, set()
    for _ in range(80):
        answer = step.step(DeformTask(scan_of(pose, *boxes), pose))
        found.add(answer.finding)
        if answer.finding == until:
            return answer, found, pose
        if answer.path is not None:
            path = answer.path.poses
        path = path[min(2, len(path) - 1) :]
        pose = (float(path[0, 0]), float(path[0, 1]), float(path[0, 2]))
    raise AssertionError(f"{until} expected, found {found}")


def test_a_free_route_stays_as_it_is():
    step, first = begun()
    answer = step.step(first)
    assert (answer.number, answer.finding, answer.place, answer.complete) == (1, "free", 0, True)
    at = (1.02, 0.03, 0.05)
    beside = (1.5, 0.25, 2.0, 0.5)
    answer = step.step(DeformTask(scan_of(at, beside), at))
    assert (answer.finding, answer.place) == ("free", 20)


@pytest.mark.parametrize(
    ("mapped", "deviation", "finding"), [(0.20, 0.0, "free"), (0.29, 0.0, "new"), (0.29, 0.03, "free")]
)
def test_a_wall_of_the_map_that_a_pose_off_brings_nearer_deforms_nothing(mapped, deviation, finding):
    """The scan shows it at 0.185 m, 0.015 m beside the truck; how far the map may be off follows from the pose."""
    step, first = begun()
    grid = room()
    cells = grid.cells.reshape(grid.height, grid.width).copy()
    cells[round((mapped - grid.origin.y) / grid.resolution) :, 44:70] = 100
    step.step(replace(first, grid=grid.model_copy(update={"cells": cells.ravel()})))
    seen = scan_of(ORIGIN, (1.2, 0.185, 2.5, 0.5))
    assert step.step(DeformTask(seen, ORIGIN, deviation=deviation)).finding == finding
    touching = scan_of(ORIGIN, (1.2, 0.15, 2.5, 0.5))
    assert step.step(DeformTask(touching, ORIGIN, deviation=deviation)).finding != "free"


def test_what_stands_on_the_route_is_passed_and_then_the_route_is_driven_again():
    step, first = begun()
    step.step(first)
    box = (1.2, -0.15, 1.5, 0.1)
    answer = step.step(DeformTask(scan_of(ORIGIN, box), ORIGIN))
    assert (answer.finding, answer.path is not None) == ("new", True)
    assert answer.path is not None
    assert np.abs(answer.path.poses[0] - ORIGIN).max() < 1e-6, "from the truck on"
    answer, found, pose = drive(step, "free", box)
    assert found == {"kept", "new", "free"}
    assert pose[0] > 1.5
    assert abs(ROUTE[answer.place, 0] - pose[0]) < 0.06


@pytest.mark.parametrize(("code", "finding"), [(0, "free"), (2, "free"), (3, "new"), (6, "new"), (19, "new")])
def test_what_stood_on_the_route_is_still_there_for_a_lidar_that_does_not_see(code, finding):
    """A hand before the window: only beams that met nothing in range show that it is gone."""
    step, first = begun()
    step.step(first)
    seen = scan_of(ORIGIN, (1.2, -0.15, 1.5, 0.1), (-1.0, 1.5, 3.0, 1.6))
    assert step.step(DeformTask(seen, ORIGIN)).finding == "new"
    ahead = np.abs(ANGLES) < 0.3
    covered = seen.model_copy(
        update={
            "ranges": np.where(ahead, math.inf, seen.ranges),
            "codes": np.where(ahead, code, seen.codes).astype(np.uint8),
        }
    )
    answer = step.step(DeformTask(covered, ORIGIN))
    assert answer.finding in (("free",) if finding == "free" else ("new", "kept"))


def test_a_route_does_not_back_into_what_was_seen_before_the_truck_turned_away():
    """A box seen ahead; then the truck stands with its back to it, and the route leads backward."""
    step, first = begun()
    box = (1.2, -0.15, 1.5, 0.1)
    away = (0.4, 0.0, math.pi)
    back = np.column_stack((np.arange(0.4, 3.01, 0.05), np.zeros(53), np.full(53, math.pi)))
    step.step(first)
    step.step(DeformTask(scan_of(ORIGIN, box), ORIGIN))
    route = PosePath(back, -np.ones(len(back)))
    answer = step.step(DeformTask(scan_of(away, box), away, route=route, number=2))
    assert answer.finding != "free"
    never, first = begun()
    never.step(first)
    assert never.step(DeformTask(scan_of(away, box), away, route=route, number=2)).finding == "free", "it saw nothing"


def test_single_beams_that_fail_hide_nothing():
    scan = scan_of(ORIGIN, (1.0, -0.5, 1.2, 0.5))
    codes = scan.codes.copy()
    codes[[3, 10, 11, 200, 201, 202]] = 7
    assert blind_beams(scan.model_copy(update={"codes": codes})).tolist() == [201]


def test_where_there_is_no_way_round_the_beginning_is_driven_and_then_it_is_blocked():
    step, first = begun()
    step.step(first)
    wall = (1.6, -2.5, 1.7, 2.5)
    answer, found, pose = drive(step, "blocked", wall)
    assert answer.reason is Reason.PATH_BLOCKED
    assert answer.text
    assert "new" in found
    assert 0.5 < pose[0] < 1.6 - 0.235, "as far as it is free"
    step.step(DeformTask(scan_of(pose), pose, route=PosePath(ROUTE, np.ones(81)), number=2))
    answer = step.step(DeformTask(scan_of(pose), pose))
    assert (answer.number, answer.finding) == (2, "free"), "what went away is forgotten"


def test_the_place_on_the_route_does_not_go_beyond_a_cusp_that_is_not_reached():
    there = np.column_stack((np.arange(0.0, 1.01, 0.05), np.zeros(21), np.zeros(21)))
    back = there[::-1][1:]
    step, first = begun(np.vstack((there, back)), np.concatenate((np.ones(21), -np.ones(20))))
    step.step(first)
    poses = [(x, 0.0, 0.0) for x in (0.0, 0.4, 0.8, 0.98, 0.7, 0.3)]
    places = [step.step(DeformTask(scan_of(pose), pose)).place for pose in poses]
    assert places == [0, 8, 16, 20, 26, 34]


def test_with_a_map_that_cannot_be_read_only_what_is_seen_counts(tmp_path, caplog):
    file = tmp_path / "map.yaml"
    file.write_text("image: [\n")
    step, task = begun()
    assert task.setup is not None
    setup = replace(task.setup, config=PlannerConfig(local_planner=RsbandConfig(), map=file))
    answer = step.step(replace(task, setup=setup, grid=None))
    assert (answer.finding, answer.number) == ("free", 1)
    (said,) = caplog.messages
    assert str(file) in said


def test_a_setup_with_a_deformer_comes_first():
    step, first = begun()
    with pytest.raises(InputError, match="setup"):
        step.step(DeformTask(first.scan, ORIGIN))
    setup = Setup(PlannerConfig(), FourWheelSteering(), Footprint(), ORIGIN)
    with pytest.raises(InputError, match=r"planner\.local_planner"):
        step.step(DeformTask(first.scan, ORIGIN, setup))
    assert first.setup is not None
    assert step.step(DeformTask(first.scan, ORIGIN, first.setup)).finding == "idle"


def among(person: tuple[tuple[float, float], tuple[float, float]], **people: float) -> list[str]:
    """Findings within 4 s of a robot that stands at the start of its route while a person (place, velocity) walks."""
    step, first = begun()
    assert first.setup is not None
    local = LocalConfig(people=PeopleConfig(**people))
    config = first.setup.config.model_copy(update={"local": local})
    step.step(replace(first, setup=replace(first.setup, config=config)))
    (x, y), (vx, vy) = person
    findings = []
    for i in range(40):
        px, py = x + vx * i / 10, y + vy * i / 10
        box = (px - 0.15, py - 0.15, px + 0.15, py + 0.15)
        seen = scan_of(ORIGIN, box).model_copy(update={"stamp": SECOND + i * SECOND // 10})
        findings.append(step.step(DeformTask(seen, ORIGIN)).finding)
    return findings


def test_it_lets_a_person_pass_who_crosses_and_goes_on_behind_him():
    findings = among(((0.8, -1.6), (0.0, 0.8)))
    assert "yields" in findings
    assert findings[-1] == "free"
    assert set(findings) == {"free", "yields"}
    assert 1.2 <= findings.count("yields") / 10 <= 3.0


def test_a_person_who_walks_ahead_or_crosses_far_ahead_deforms_nothing():
    assert set(among(((0.9, 0.0), (0.6, 0.0)))[8:]) == {"free"}
    assert set(among(((1.4, -1.0), (0.0, 0.8)))[8:]) == {"free"}


def test_its_patience_ends_and_then_a_person_is_an_obstacle():
    findings = among(((0.8, -1.6), (0.0, 0.8)), patience=0.5)
    assert findings.count("yields") <= 6
    after = findings[findings.index("yields") :]
    assert {"new", "blocked"} & set(after), "the person was no obstacle any more"


def test_a_jump_of_the_localisation_makes_no_post_walk():
    """The pose in the map jumps 0.2 m towards the post; odometry says that the robot stands."""
    step, first = begun()
    box = (0.65, -0.75, 0.8, -0.6)
    findings = []
    step.step(first)
    for i in range(25):
        pose = (0.0, 0.2 if i >= 12 else 0.0, 0.0)
        seen = scan_of(ORIGIN, box).model_copy(update={"stamp": SECOND + i * SECOND // 10})
        findings.append(step.step(DeformTask(seen, pose, odometry=(3.0, 1.0, 2.0))).finding)
    assert "yields" not in findings
