import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from monstertruck_planners.route import reeds_shepp as words
from monstertruck_planners.route.motion import MotionPath, joined, moved
from monstertruck_planners.route.reeds_shepp import ReedsShepp
from monstertruck_runtime.errors import InputError

R = 0.757
CAR = ReedsShepp(R, steering="front", reference=-0.16)
TRUCK = ReedsShepp(0.378, crab_angle=0.4)

coordinates = st.one_of(st.floats(-4, 4), st.sampled_from([0.0, R, 2 * R, -R, 0.5]))
angles = st.one_of(st.floats(-7, 7), st.sampled_from([0.0, math.pi, -math.pi, math.pi / 2, -math.pi / 2]))
poses = st.tuples(coordinates, coordinates, angles)


def off(path, goal):
    error = path.end - np.asarray(goal)
    return math.hypot(error[0], error[1]), abs(math.remainder(error[2], math.tau))


@pytest.mark.parametrize("steer", [CAR, TRUCK])
@given(start=poses, goal=poses)
@settings(max_examples=150, deadline=None)
def test_paths_reach_the_goal_exactly(steer, start, goal):
    path = steer.path(start, goal)
    assert off(path, goal) == pytest.approx((0.0, 0.0), abs=1e-9)
    assert path.length == pytest.approx(steer.distance(start, goal)[0], abs=1e-9)
    assert path.greatest_curvature <= 1 / steer.radius + 1e-12
    assert np.abs(path.segments[:, 2]).max(initial=0.0) <= steer.crab_angle


@given(start=poses, goal=poses)
@settings(max_examples=150, deadline=None)
def test_the_metric(start, goal):
    there, back = CAR.distance([start, goal], [goal, start])
    assert there == pytest.approx(back, abs=1e-8)
    assert there >= math.hypot(goal[0] - start[0], goal[1] - start[1]) - 1e-9
    assert there >= R * abs(math.remainder(goal[2] - start[2], math.tau)) - 1e-9
    assert TRUCK.distance(start, goal)[0] <= ReedsShepp(0.378).distance(start, goal)[0] + 1e-12


@given(a=poses, b=poses, c=poses)
@settings(max_examples=150, deadline=None)
def test_the_triangle(a, b, c):
    whole, first, second = CAR.distance([a, a, b], [c, b, c])
    assert whole <= first + second + 1e-8


@pytest.mark.parametrize("pattern", range(8))
@pytest.mark.parametrize("backward", [1.0, -1.0])
@given(t=st.floats(0.05, 1.5), u=st.floats(0.05, 1.5), v=st.floats(0.05, 1.5), flip=st.booleans(), mirror=st.booleans())
@settings(max_examples=25, deadline=None)
def test_no_word_is_shorter_than_the_distance(pattern, backward, t, u, v, flip, mirror):
    signs = {words.LRL: (1, -1, 1), words.LRLR_SAME: (1, 1, -1), words.LRLR_CUSP: (1, -1, 1)}
    signs |= {words.LRSL: (1, -1, -1), words.LRSR: (1, -1, -1), words.LRSLR: (1, -1, 1)}
    st_, su, sv = signs.get(pattern, (1, 1, 1))
    solution = np.array(
        [0.0, pattern, -1.0 if flip else 1.0, -1.0 if mirror else 1.0, backward, st_ * t, su * u, sv * v]
    )
    rows = np.empty((5, 3))
    word = MotionPath(np.zeros(3), rows[: words.write_segments(solution, R, rows, np.empty(5))])
    assert len(word.segments) == words.PIECES[pattern]
    assert CAR.distance(np.zeros(3), word.end)[0] <= word.length + 1e-8


def test_a_shuffle_sideways_is_two_crab_moves():
    path = TRUCK.path((0, 0, 0), (0, 0.2, 0))
    assert (path.segments[:, 1] == 0.0).all()
    assert np.abs(path.segments[:, 2]) == pytest.approx([0.4, 0.4])
    assert path.steering == ("crab", "crab")
    assert path.length == pytest.approx(0.2 / math.sin(0.4))
    assert path.cusps == 1


def priced(path, reverse, cusp):
    return path.length + (reverse - 1) * path.backward + cusp * path.cusps


@given(start=poses, goal=poses, reverse=st.floats(1, 4), cusp=st.floats(0, 2))
@settings(max_examples=100, deadline=None)
def test_costs_choose_among_the_words(start, goal, reverse, cusp):
    dear = ReedsShepp(R, reverse_cost=reverse, cusp_cost=cusp)
    chosen, shortest = dear.path(start, goal), CAR.path(start, goal)
    assert dear.distance(start, goal)[0] == pytest.approx(priced(chosen, reverse, cusp), abs=1e-8)
    assert priced(chosen, reverse, cusp) <= priced(shortest, reverse, cusp) + 1e-8


def test_dear_cusps_and_crab_moves_are_left_out():
    beside = (0.3, 0.9, 0.0)
    assert CAR.path((0, 0, 0), beside).cusps > 0
    assert ReedsShepp(R, cusp_cost=3.0).path((0, 0, 0), beside).cusps < CAR.path((0, 0, 0), beside).cusps
    no_crab = ReedsShepp(0.378, crab_angle=0.4, crab_cost=3.0).path((0, 0, 0), (2, 0.5, 0))
    assert set(TRUCK.path((0, 0, 0), (2, 0.5, 0)).steering) == {"crab"}
    assert "crab" not in no_crab.steering


def test_samples_lie_on_the_path():
    path = MotionPath(np.array([1.0, 2.0, math.pi / 2]), np.array([[1.0, 0.5, 0.0], [-0.5, 0.0, 0.0], [0.4, 0.0, 0.3]]))
    samples = path.sample(0.1)
    assert len(samples.poses) == 1 + 10 + 5 + 4
    assert samples.travelled == pytest.approx(np.linspace(0.0, 1.9, 20))
    assert samples.direction.tolist() == [1.0] * 11 + [-1.0] * 5 + [1.0] * 4
    assert set(samples.curvature[:11]) == {0.5}
    assert samples.sideslip[-1] == 0.3
    assert samples.poses[10] == pytest.approx(path.ends[1])
    step = np.diff(samples.poses[:, :2], axis=0)
    assert np.hypot(step[:, 0], step[:, 1]) == pytest.approx(np.full(19, 0.1), rel=1e-3)
    assert path.cusps == 2
    assert path.backward == 0.5


@given(start=poses, goal=poses, begin=st.floats(0, 6), length=st.floats(0, 3))
@settings(max_examples=80, deadline=None)
def test_parts_add_up(start, goal, begin, length):
    path = TRUCK.path(start, goal)
    pieces = [path.part(0, begin), path.part(begin, begin + length), path.part(begin + length, math.inf)]
    whole = joined(pieces)
    assert whole.end == pytest.approx(path.end, abs=1e-6)
    assert whole.length == pytest.approx(path.length, abs=1e-6)


def test_messages_speak_of_the_base():
    path = MotionPath(np.zeros(3), np.array([[-1.0, 0.0, 0.0]]), "front", -0.16)
    message = path.message(stamp=5, step=0.5, name="out")
    assert message.poses.reshape(-1, 3)[:, 0] == pytest.approx([0.16, -0.34, -0.84])
    assert message.directions.tolist() == [-1.0, -1.0, -1.0]
    assert message.steering == ("front",) * 3
    assert moved(path.base_poses(0.5), -0.16) == pytest.approx(path.sample(0.5).poses)
    still = CAR.path((1, 2, 3), (1, 2, 3))
    assert (still.length, len(still.sample(0.1).poses)) == (0.0, 1)


def test_nonsense_is_refused():
    for arguments in ((0.0,), (1.0, 2.0), (1.0, 0.0, 0.5), (math.nan,), (1.0, 0.0, 1.0, -1.0)):
        with pytest.raises(InputError, match="Reeds-Shepp"):
            ReedsShepp(*arguments)
    with pytest.raises(InputError, match="finite"):
        CAR.path((0, 0, math.nan), (0, 0, 0))
    with pytest.raises(InputError, match="motion path"):
        MotionPath(np.zeros(2), np.zeros((0, 3)))
    with pytest.raises(InputError, match="steering modes"):
        MotionPath(np.zeros(3), np.ones((2, 3)), ("front",))
    with pytest.raises(InputError, match="step"):
        CAR.path((0, 0, 0), (1, 0, 0)).sample(0.0)
    with pytest.raises(InputError, match="start at the end"):
        CAR.path((0, 0, 0), (1, 0, 0)).then(CAR.path((0, 0, 0), (1, 0, 0)))
