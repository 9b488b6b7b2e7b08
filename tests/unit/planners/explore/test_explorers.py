"""What explorers choose in small maps, and what the step says of it."""

import math

import numpy as np
import pytest
from pydantic import TypeAdapter

from monstertruck_planners.collision import Footprint
from monstertruck_planners.explore.api import make_explorer
from monstertruck_planners.explore.catalog import EXPLORERS, AnyExplorer
from monstertruck_planners.explore.config import AuthorConfig, InformationConfig, NearestConfig
from monstertruck_planners.explore.exchange import ExploreSetup, ExploreTask, Viewpoint
from monstertruck_planners.explore.explore_step import ExploringStep
from monstertruck_planners.explore.kernels import new_area, sees
from monstertruck_runtime.errors import InputError
from monstertruck_schemas.base import Pose2D
from monstertruck_schemas.state import Grid

KINDS = [NearestConfig(), AuthorConfig(), InformationConfig()]
MIDDLE = (5.0, 5.0, 0.0)


def hall(*gaps: tuple[float, float, float, float]) -> Grid:
    """A hall of 8 m by 8 m round (5, 5) with walls; x, y of both ends of each gap in them, m."""
    cells = np.full((200, 200), -1, np.int8)
    cells[20:180, 20:180] = 0
    cells[20:180, [20, 179]] = 100
    cells[[20, 179], 20:180] = 100
    for x0, y0, x1, y1 in gaps:
        cells[round(y0 * 20) : round(y1 * 20) + 1, round(x0 * 20) : round(x1 * 20) + 1] = 0
    return Grid(
        stamp=0, received=0, seq=0, frame="map", resolution=0.05, width=200, height=200,
        origin=Pose2D(x=0.0, y=0.0, yaw=0.0), cells=cells.reshape(-1),
    )  # fmt: skip


EAST, WEST, NORTH = (8.95, 4.5, 8.95, 5.5), (1.0, 4.5, 1.0, 5.5), (2.0, 8.95, 3.0, 8.95)


def step_of(config, grid: Grid) -> ExploringStep:
    step = ExploringStep()
    step.step(ExploreTask(MIDDLE, grid, (), ExploreSetup(config, Footprint(), 0.5)))
    return step


@pytest.mark.parametrize("config", KINDS, ids=lambda config: config.kind)
def test_it_looks_through_the_only_gap_and_faces_it(config):
    answer = step_of(config, hall(EAST)).step(ExploreTask(MIDDLE, choose=True, home=(2.0, 2.0, 0.0)))
    assert answer.target is not None
    assert math.dist(answer.target.frontier, (8.95, 5.0)) < 0.1
    x, y, yaw = answer.target.pose
    assert abs(math.remainder(math.atan2(5.0 - y, 8.95 - x) - yaw, math.tau)) < 2.1
    assert x > 5.5
    assert answer.target.gain > 0.3
    assert (answer.frontiers, answer.banned) == (1, 0)
    assert answer.home == pytest.approx(4.24, abs=0.4)


@pytest.mark.parametrize("config", KINDS, ids=lambda config: config.kind)
def test_banned_and_closed_places_are_no_options(config):
    step = step_of(config, hall(EAST))
    banned = step.step(ExploreTask(MIDDLE, choose=True, banned=((8.9, 5.1),)))
    assert (banned.target, banned.frontiers, banned.banned) == (None, 0, 1)
    assert step_of(config, hall()).step(ExploreTask(MIDDLE, choose=True)).target is None


def test_it_looks_from_elsewhere_than_places_that_could_not_be_reached():
    step = step_of(InformationConfig(), hall(EAST))
    first = step.step(ExploreTask(MIDDLE, choose=True)).target
    assert first is not None
    other = step.step(ExploreTask(MIDDLE, choose=True, avoided=(first.pose[:2],))).target
    assert other is not None
    assert math.dist(first.pose[:2], other.pose[:2]) > 0.25
    assert math.dist(first.frontier, other.frontier) < 0.1


def test_a_gap_too_narrow_for_the_robot_is_passed_over():
    assert (
        step_of(NearestConfig(), hall((8.95, 5.0, 8.95, 5.25), (4.0, 8.95, 4.2, 8.95)))
        .step(ExploreTask(MIDDLE, choose=True))
        .target
        is None
    )


def test_the_nearest_one_is_chosen_and_kept_until_it_is_gone():
    step = step_of(NearestConfig(), hall(EAST, NORTH))
    first = step.step(ExploreTask((6.0, 5.0, 0.0), choose=True)).target
    assert first is not None
    assert math.dist(first.frontier, (8.95, 5.0)) < 0.1
    kept = step.step(ExploreTask((3.0, 7.0, 0.0), choose=True, current=first))
    assert kept.kept
    assert kept.target is first
    walled = hall(NORTH)
    other = step.step(ExploreTask((6.0, 5.0, 0.0), walled, choose=True, current=first))
    assert not other.kept
    assert other.target is not None
    assert math.dist(other.target.frontier, (2.5, 8.95)) < 0.1


def test_the_author_keeps_his_goal_until_his_patience_ends_and_likes_to_go_straight_on():
    step = step_of(AuthorConfig(), hall(EAST, WEST))
    first = step.step(ExploreTask((5.0, 5.0, math.pi), choose=True)).target
    assert first is not None
    assert first.frontier[0] < 2.0
    walled = hall(EAST)
    assert step.step(ExploreTask(MIDDLE, walled, choose=True, current=first, pursued=29.0)).kept
    other = step.step(ExploreTask(MIDDLE, choose=True, current=first, pursued=31.0)).target
    assert other is not None
    assert other.frontier[0] > 8.0


def test_information_prefers_the_wide_opening_to_the_narrow_one_a_little_nearer():
    wide, narrow = (8.95, 3.0, 8.95, 7.0), (1.0, 4.75, 1.0, 5.25)
    grid = hall(wide, narrow)
    chosen = step_of(InformationConfig(turning=0.0), grid).step(ExploreTask((4.6, 5.0, 1.57), choose=True)).target
    assert chosen is not None
    assert chosen.frontier[0] > 8.0


@pytest.mark.parametrize(("better", "kept"), [(20.0, True), (1.0, False)])
def test_information_keeps_its_goal_unless_another_one_is_that_much_better(better, kept):
    wide, narrow = (8.95, 3.0, 8.95, 7.0), (1.0, 4.75, 1.0, 5.25)
    pose = (4.8, 5.0, math.pi / 2)
    first = step_of(InformationConfig(), hall(narrow)).step(ExploreTask(pose, choose=True)).target
    assert first is not None
    step = step_of(InformationConfig(better=better), hall(wide, narrow))
    assert step.step(ExploreTask(pose, choose=True, current=first)).kept is kept


def test_a_frontier_is_looked_at_from_where_the_robot_can_go_also_once_a_door_is_open():
    """What was found for it holds only while the same ground can be reached."""
    grid = hall(EAST)
    shut = grid.cells.reshape(200, 200).copy()
    shut[20:180, 150:154] = 100
    closed = grid.model_copy(update={"cells": shut.reshape(-1)})
    step = step_of(InformationConfig(), closed)
    assert step.step(ExploreTask(MIDDLE, choose=True)).target is None
    shut[80:120, 150:154] = 0
    opened = step.step(ExploreTask(MIDDLE, grid.model_copy(update={"cells": shut.reshape(-1)}), choose=True)).target
    assert opened is not None
    assert math.dist(opened.frontier, (8.95, 5.0)) < 0.1


def test_round_a_narrow_corner_it_looks_from_where_the_robot_has_room():
    """The places that show most lie at the edge of unknown ground, where the footprint overlaps it."""
    cells = np.full((100, 160), -1, np.int8)
    cells[48:74, 8:140] = 100
    cells[8:74, 8:32] = 100
    cells[50:72, 10:138] = 0
    cells[10:72, 10:30] = 0
    row, column = np.mgrid[0:100, 0:160]
    edge = np.minimum(46 + (column - 10) * 14 / 22, 60 - (column - 32) * 2)
    cells[(row < edge) & (column < 40) & (cells == 0)] = -1
    grid = Grid(
        stamp=0, received=0, seq=0, frame="map", resolution=0.05, width=160, height=100,
        origin=Pose2D(x=0.0, y=0.0, yaw=0.0), cells=cells.reshape(-1),
    )  # fmt: skip
    answer = step_of(InformationConfig(), grid).step(ExploreTask((4.0, 3.0, math.pi), choose=True))
    assert answer.target is not None
    assert math.dist(answer.target.frontier, (1.2, 2.8)) < 0.3
    assert answer.target.gain > 1.0


def test_sight_ends_at_obstacles_and_new_area_at_depth():
    cells = np.zeros((60, 60), np.int8)
    cells[:, 30] = 100
    cells[:, 50:] = -1
    assert not sees(cells, 10.0, 10.0, 40.0, 10.0)
    assert sees(cells, 32.0, 10.0, 55.0, 20.0)
    assert new_area(cells, 10.5, 30.5, 0.0, 0.1, 100.0, 5.0, 8) == 0.0
    behind = new_area(cells, 40.5, 30.5, 0.0, 0.2, 100.0, 4.0, 16)
    assert behind == pytest.approx(0.2 * np.mean([10, 11, 12, 13]) * 4, rel=0.15)
    assert new_area(cells, 40.5, 30.5, 0.0, 0.2, 8.0, 4.0, 16) == 0.0


def test_the_step_asks_for_a_setup_and_waits_for_a_map():
    with pytest.raises(InputError, match="setup"):
        ExploringStep().step(ExploreTask(MIDDLE))
    step = ExploringStep()
    answer = step.step(ExploreTask(MIDDLE, setup=ExploreSetup(InformationConfig(), Footprint(), 0.5), choose=True))
    assert (answer.target, answer.known) == (None, 0.0)


def test_a_robot_on_unknown_ground_begins_where_it_stands():
    grid = hall(EAST)
    cells = grid.cells.reshape(200, 200).copy()
    cells[96:104, 94:106] = -1
    hidden = grid.model_copy(update={"cells": cells.reshape(-1)})
    answer = step_of(InformationConfig(), hidden).step(ExploreTask(MIDDLE, choose=True))
    assert answer.target is not None


def test_kinds_are_a_catalog_whose_default_is_information():
    assert list(EXPLORERS) == ["information", "nearest", "author"]
    assert TypeAdapter(AnyExplorer).validate_python({}).kind == "information"
    assert all(hasattr(make_explorer(config), "choose") for config in KINDS)
    assert Viewpoint((0.0, 0.0, 0.0), (1.0, 0.0)).path_length == 0.0
