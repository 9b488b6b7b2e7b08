"""Circle and line from noisy poses of a known motion, and from what is no motion at all."""

import math

import numpy as np
import pytest

from monstertruck_runtime.errors import InputError
from monstertruckd.tools.study.analysis import centre_track, circle, line, velocities
from monstertruckd.tools.study.log import Run
from monstertruckd.tools.study.report import analyse

ARM = (0.005, -0.21)


def circling(seconds=150.0, drift=(-3e-4, 1e-4), rate=0.13, sigma=0.001, turn=0.01, seed=1):
    rng = np.random.default_rng(seed)
    times = np.arange(0.0, seconds, 0.05)
    yaw = 0.4 + rate * times
    c, s = np.cos(yaw), np.sin(yaw)
    x = 0.1 + drift[0] * times + c * ARM[0] - s * ARM[1]
    y = -0.2 + drift[1] * times + s * ARM[0] + c * ARM[1]
    poses = np.array([x, y, yaw]) + rng.standard_normal((3, times.size)) * [[sigma], [sigma], [turn]]
    poses[2] = np.remainder(poses[2] + math.pi, math.tau) - math.pi
    return times, poses


@pytest.mark.parametrize("rate", [0.13, -0.13])
@pytest.mark.parametrize("seed", range(5))
def test_a_circle_whose_centre_moves(rate, seed):
    found = circle(*circling(rate=rate, seed=seed))
    assert found.radius == pytest.approx(math.hypot(*ARM), rel=2e-3)
    assert found.speed == pytest.approx(0.13 * math.hypot(*ARM), rel=3e-3)
    assert found.yaw_rate == pytest.approx(rate, rel=2e-3)
    assert found.drift == pytest.approx((-3e-4, 1e-4), abs=6e-6)
    assert found.centre == pytest.approx((0.1, -0.2), abs=1e-3)
    assert found.arm == pytest.approx(ARM, abs=1e-3)
    assert found.laps == pytest.approx(0.13 * 150 / math.tau, rel=0.01)


def test_without_noise_it_is_exact():
    times, poses = circling(sigma=0.0, turn=0.0)
    found = circle(times, poses)
    assert found.residual < 1e-9
    track = centre_track(poses, found)
    assert track[0] == pytest.approx(0.1 - 3e-4 * times)
    at, (vx, vy) = velocities(times, poses)
    assert np.hypot(vx, vy) == pytest.approx(found.speed, abs=5e-4)
    assert at.size == vx.size


def to_and_fro(passes=12, turn=0.01, bend=0.0, sigma=0.0, seed=1):
    rng = np.random.default_rng(seed)
    pose, rows = np.array([0.0, 0.0, 0.0]), []
    time, speed, step = 0.0, 0.035, 0.05
    for i in range(passes):
        direction = 1.0 if i % 2 == 0 else -1.0
        for k in range(400):
            if i and k * step < 0.2:
                pose[2] += turn * step / 0.2
            pose += np.array([math.cos(pose[2]), math.sin(pose[2]), bend]) * direction * speed * step
            time += step
            rows.append((time, *(pose + rng.standard_normal(3) * [sigma, sigma, 5 * sigma]), direction))
    times, x, y, yaw, directions = np.array(rows).T
    return times, np.array([x, y, yaw]), directions


def test_passes_of_a_robot_that_turns_at_every_reversal():
    found = line(*to_and_fro(sigma=0.001))
    assert found.passes == 12
    assert found.length == pytest.approx(0.035 * 19.0, rel=0.01)
    assert found.speed == pytest.approx(0.035, rel=3e-3)
    assert found.reversal_turn == pytest.approx(0.01, abs=1e-3)
    assert found.reversal_spread < 2e-3
    assert found.spread > 0.05
    assert found.bend < 1e-3


def test_a_bend_is_the_sagitta_over_the_length():
    curvature = 0.1
    found = line(*to_and_fro(passes=2, turn=0.0, bend=curvature))
    assert found.bend == pytest.approx(curvature * found.length / 8, rel=0.02)


def broken(what):
    times, poses = circling(seconds=20.0, rate=0.2)
    match what:
        case "few":
            return times[:10], poses[:, :10]
        case "nan":
            poses[1, 5] = math.nan
        case "stuck":
            poses[:] = poses[:, :1]
        case "back":
            times[7] = times[3]
        case "shape":
            return times, poses[:2]
    return times, poses


@pytest.mark.parametrize(
    ("what", "said"),
    [
        ("few", "10 poses"),
        ("nan", "finite numbers"),
        ("stuck", "turns by 0.00 rad"),
        ("back", "increasing times"),
        ("shape", "expected \\(3,"),
    ],
)
def test_what_is_no_circle_says_so(what, said):
    with pytest.raises(InputError, match=said):
        circle(*broken(what))


def test_a_line_without_a_pass_says_so():
    times, poses, directions = to_and_fro(passes=2)
    with pytest.raises(InputError, match="no pass has"):
        line(times, poses, 0.0 * directions)
    with pytest.raises(InputError, match="finite"):
        line(times, poses * math.nan, directions)


def test_a_run_that_says_nothing_is_named():
    times, poses = circling(seconds=1.0)
    short = Run(0.785, 1.57, times, poses, np.ones_like(times))
    with pytest.raises(InputError, match=r"2:1, 1\.57 rad/s: 20 poses of the stand: expected at least 40"):
        analyse([short])
