"""Looking at walls for tags: where from, what has been looked at, and when it is enough."""

import math

import numpy as np

from monstertruck_planners.collision import Footprint
from monstertruck_planners.explore.config import InformationConfig
from monstertruck_planners.explore.exchange import CameraView, ExploreSetup, ExploreTask
from monstertruck_planners.explore.explore_step import ExploringStep
from monstertruck_planners.explore.look import faces_of
from monstertruck_planners.explore.service import state_of
from monstertruck_schemas.base import Pose2D
from monstertruck_schemas.plan import ExplorationPhase
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.state import Grid
from tests.unit.planners.explore.test_exploration import NOTHING, SteppedExploration

MIDDLE = (2.5, 2.5, 0.0)


def room() -> Grid:
    """3 m by 3 m round (2.5, 2.5), nothing of it unknown."""
    cells = np.full((100, 100), -1, np.int8)
    cells[19:81, 19:81] = 100
    cells[20:80, 20:80] = 0
    return Grid(
        stamp=0, received=0, seq=0, frame="map", resolution=0.05, width=100, height=100,
        origin=Pose2D(x=0.0, y=0.0, yaw=0.0), cells=cells.reshape(-1),
    )  # fmt: skip


def test_every_wall_is_looked_at_from_near_and_then_nothing_is_left():
    step, camera = ExploringStep(), CameraView()
    step.step(ExploreTask(MIDDLE, room(), (), ExploreSetup(InformationConfig(), Footprint(), 0.5, camera=camera)))
    pose, current, looked = MIDDLE, None, 0
    for _ in range(40):
        answer = step.step(ExploreTask(pose, choose=True, current=current, find=True))
        if answer.target is None:
            break
        x, y, yaw = answer.target.pose
        wall = answer.target.frontier
        off = math.dist((x + 0.18 * math.cos(yaw), y + 0.18 * math.sin(yaw)), wall)
        assert camera.nearest < off < camera.reach
        assert abs(math.remainder(math.atan2(wall[1] - y, wall[0] - x) - yaw, math.tau)) < camera.view / 2
        again = step.step(ExploreTask(pose, choose=True, current=answer.target, find=True))
        assert again.kept, "it goes on while the wall has not been looked at"
        pose, current, looked = answer.target.pose, answer.target, looked + 1
    assert 4 <= looked < 25
    assert answer.target is None
    assert step.step(ExploreTask(pose, choose=True)).target is None, "without --find there was nothing to look at"


def test_faces_point_away_from_their_wall():
    step = ExploringStep()
    step.step(ExploreTask(MIDDLE, room(), (), ExploreSetup(InformationConfig(), Footprint(), 0.5)))
    faces = faces_of(step._map)
    inward = ((np.array(MIDDLE[:2]) - faces.points) * faces.normals).sum(axis=1)
    assert len(faces.keys) == len(set(faces.keys.tolist())) > 40
    assert (inward > 0.5).all()


def test_it_ends_when_enough_is_found_and_says_how_much_was_not():
    stepped = SteppedExploration(find=3)
    stepped.drive()
    stepped.step(found=2)
    assert stepped.run.phase is ExplorationPhase.DRIVING
    reported = state_of(stepped.run, "information", 0)
    assert (reported.found, reported.find) == (2, 3)
    stepped.step(found=3)
    assert stepped.run.phase is ExplorationPhase.RETURNING
    assert stepped.run.final is Reason.POINTS_FOUND
    short = SteppedExploration(find=3)
    while short.run.final is Reason.DRIVING:
        short.look(NOTHING)
    assert short.run.final is Reason.EXPLORED
    assert "0 of 3 points" in short.run.final_text
