"""How far messages are apart, and in what."""

import math

import numpy as np
import pytest

from monstertruck_estimation.transforms import planar
from monstertruck_schemas.base import Pose2D
from monstertruck_schemas.plan import Path, StabiliserCommand, TrackerState
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.state import Grid, Transforms
from monstertruckd.tools.replay_check.comparison import Difference, Kind, differences
from tests.unit.tools.logs.log_kit import odometry

HEADER = {"stamp": 1, "received": 1, "seq": 0}


def found(before, after):
    return {(one.kind, one.field): one.value for one in differences(before, after)}


def test_equal_messages_and_other_headers_are_no_difference():
    assert differences(odometry(1, 0), odometry(1, 0)) == []
    goal = StabiliserCommand(**HEADER, pitch=0.1, roll=0.2)
    assert differences(goal, goal.model_copy(update={"stamp": 5, "received": 6, "seq": 7})) == []


def test_a_pose_is_measured_as_distance_and_turn():
    before = odometry(1, 0)
    after = before.model_copy(update={"pose": Pose2D(x=0.03, y=0.04, yaw=-0.2)})
    assert found(before, after) == {(Kind.LENGTH, "pose"): pytest.approx(0.05), (Kind.ANGLE, "pose.yaw"): 0.2}


def test_angles_go_the_short_way():
    before = StabiliserCommand(**HEADER, pitch=math.pi - 0.01, roll=0.0)
    after = before.model_copy(update={"pitch": -math.pi + 0.01})
    assert found(before, after) == {(Kind.ANGLE, "pitch"): pytest.approx(0.02)}


def test_transforms_are_named_by_their_frame():
    def tree(*poses):
        rows = (planar("map", "odom", 1, poses[0]), planar("odom", "base", 1, poses[1]))
        return Transforms(**HEADER, frame="map", transforms=rows)

    turned = found(tree((0, 0, 0), (1, 1, 3.0)), tree((0, 0, 0), (1, 1.5, -3.0)))
    assert turned == {
        (Kind.LENGTH, "base.translation"): pytest.approx(0.5),
        (Kind.ANGLE, "base.rotation"): pytest.approx(math.tau - 6),
    }


def test_no_number_is_infinitely_far_from_one_and_equal_to_its_like():
    number = StabiliserCommand(**HEADER, pitch=0.1, roll=0.2)
    none = number.model_copy(update={"pitch": math.nan})
    assert differences(number, none) == differences(none, number) == [Difference(Kind.ANGLE, "pitch", math.inf)]
    assert differences(none, none.model_copy()) == []
    endless = number.model_copy(update={"pitch": math.inf})
    assert differences(number, endless) == [Difference(Kind.ANGLE, "pitch", math.inf)]
    place = odometry(1, 0)
    turned = place.model_copy(update={"pose": Pose2D.model_construct(x=math.nan, y=0.0, yaw=math.nan)})
    assert found(place, turned) == {(Kind.LENGTH, "pose"): math.inf, (Kind.ANGLE, "pose.yaw"): math.inf}
    assert differences(turned, turned.model_copy()) == []
    way = Path(**HEADER, poses=np.zeros(9), directions=np.ones(3), name="way")
    lost = way.model_copy(update={"poses": np.array([0, 0, 0, 0, 0, 0, 0, 0, math.nan])})
    assert found(way, lost) == {(Kind.ANGLE, "poses.yaw"): math.inf}
    row = odometry(1, 0)
    hole = row.model_copy(update={"pose_covariance": np.where(np.arange(9) == 3, math.nan, row.pose_covariance)})
    assert found(row, hole) == {(Kind.NUMBER, "pose_covariance"): math.inf}
    assert differences(hole, hole.model_copy(update={"pose_covariance": hole.pose_covariance.copy()})) == []


def test_what_cannot_be_subtracted_is_text():
    state = {"cross_track": 0.0, "heading_error": 0.0, "along": 1.0, "length": 2.0}
    before = TrackerState(**HEADER, path="a", outcome=Reason.DRIVING, **state)
    after = TrackerState(**HEADER, path="b", outcome=Reason.DRIVING, **state | {"along": 1.5})
    assert found(before, after) == {(Kind.TEXT, "path"): math.inf, (Kind.LENGTH, "along"): 0.5}
    sources = odometry(1, 0).model_copy(update={"sources": ("drive",)})
    assert differences(odometry(1, 0), sources) == [Difference(Kind.TEXT, "sources", math.inf)]


def test_arrays_by_their_greatest_element_or_shape():
    before = odometry(1, 0)
    covariance = np.arange(9.0)
    covariance[4] += 0.5
    assert found(before, before.model_copy(update={"pose_covariance": covariance})) == {
        (Kind.NUMBER, "pose_covariance"): 0.5
    }


def test_grids_by_their_mean_cell():
    def grid(cells, width=2):
        values = np.array(cells, np.int8)
        return Grid(
            **HEADER,
            resolution=0.1,
            width=width,
            height=len(cells) // width,
            origin=Pose2D(x=0, y=0, yaw=0),
            cells=values,
        )

    assert found(grid([0, 0, 0, 100]), grid([0, 0, 0, 0])) == {(Kind.NUMBER, "cells"): 0.25}
    assert found(grid([0, 0]), grid([0, 0, 0, 0])) == {(Kind.TEXT, "size"): math.inf}


def test_paths_by_how_far_they_lead_apart():
    def path(poses, directions, name="goal-1.1"):
        values = np.array(poses, np.float64)
        return Path(**HEADER, frame="map", poses=values.ravel(), directions=np.array(directions, np.float64), name=name)

    before = path([(0, 0, 0), (1, 0, 0), (2, 0, 0)], [1, 1, 1])
    longer = path([(0, 0, 0), (1, 0.04, 0), (1.5, 0.02, 0.1), (2, 0, 0)], [1, 1, 1, 1])
    assert found(before, before) == {}
    assert found(before, longer) == {
        (Kind.LENGTH, "poses"): pytest.approx(math.hypot(0.5, 0.02)),
        (Kind.ANGLE, "poses.yaw"): pytest.approx(0.1),
    }
    cusp = path([(0, 0, 0), (1, 0, 0), (2, 0, 0)], [1, 1, -1], "goal-1.2")
    assert found(before, cusp) == {(Kind.TEXT, "directions"): math.inf, (Kind.TEXT, "name"): math.inf}
    assert found(before, path([], [])) == {(Kind.TEXT, "poses"): math.inf}
