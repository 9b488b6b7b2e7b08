"""Paths that end early: the truck brakes where it is and drives nothing of the path again."""

from types import SimpleNamespace

import numpy as np
import pytest

from monstertruck_planners.goals.path_publisher import PathPublisher
from monstertruck_planners.pose_path import PosePath
from monstertruck_planners.track.segments import SegmentedPath
from monstertruck_schemas.reasons import Reason

X = np.concatenate((np.arange(21), np.arange(19, -1, -1))) * 0.05
THERE_AND_BACK = PosePath(
    poses=np.column_stack((X, np.zeros((len(X), 2)))),
    directions=np.where(np.arange(len(X)) <= 20, 1.0, -1.0),
    steering=("counter",) * len(X),
    clearance=np.full(len(X), 0.3),
)
"""One metre ahead and back."""


class Outbox(list):
    def next_seq(self) -> int:
        return len(self)

    put = list.append


@pytest.mark.parametrize("along", [0.02, 0.5, 0.98, 1.02, 1.5, 1.98])
def test_a_path_cut_short_begins_where_the_truck_is(along: float):
    paths, tracker = Outbox(), SimpleNamespace(latest=None)
    backward = along > 1.0
    x, speed = 1.0 - abs(1.0 - along), -0.1 if backward else 0.1
    pose = SimpleNamespace(x=x, y=0.0, yaw=0.0)
    odometry = SimpleNamespace(frame="map", pose=pose, twist=SimpleNamespace(vx=speed))
    inputs = SimpleNamespace(pose=SimpleNamespace(latest=odometry), tracker=tracker)
    publisher = PathPublisher(SimpleNamespace(now=lambda: 0), inputs, SimpleNamespace(path=paths), 0.3)
    publisher.follow(THERE_AND_BACK, "goal")
    tracker.latest = SimpleNamespace(path=paths[-1].name, along=along, outcome=Reason.DRIVING)
    publisher.brake("held-up")
    path = SegmentedPath(paths[-1], (x, 0.0, 0.0), 2.0)
    left = path.length - path.along(path.start)
    assert left < 0.15, "the truck brakes within a few centimetres"
    assert path.runs[path.start.run].direction == (-1.0 if backward else 1.0)
    # What was driven counts once.
    assert publisher.followed.before == pytest.approx(along)
    assert path.along(path.start) < 0.06


def test_a_truck_that_brakes_comes_to_rest_at_the_end_of_the_halt_path():
    paths, tracker, newest = Outbox(), SimpleNamespace(latest=None), SimpleNamespace(latest=None)
    twist = SimpleNamespace(vx=0.2)
    odometry = SimpleNamespace(frame="map", pose=SimpleNamespace(x=0.3, y=0.0, yaw=0.0), twist=twist)
    inputs = SimpleNamespace(pose=SimpleNamespace(latest=odometry), tracker=tracker, path=newest)
    publisher = PathPublisher(SimpleNamespace(now=lambda: 0), inputs, SimpleNamespace(path=paths), 0.3)
    publisher.follow(THERE_AND_BACK, "goal")
    newest.latest = paths[-1]
    tracker.latest = SimpleNamespace(path=paths[-1].name, along=0.3, outcome=Reason.DRIVING)
    assert publisher.rest is None, "a truck that follows a route does not brake"
    publisher.halt("halt")
    newest.latest = paths[-1]
    braking = 0.2**2 / (2 * 0.3)
    assert publisher.rest is not None
    assert 0.3 + braking <= publisher.rest[0] <= 0.3 + braking + 0.06
    twist.vx = 0.0
    assert publisher.rest is None, "a truck at rest sets off from its pose"
    twist.vx, newest.latest = 0.2, object()
    assert publisher.rest is None, "another source moves it"
