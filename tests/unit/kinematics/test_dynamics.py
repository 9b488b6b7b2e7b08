"""Single-track dynamics: steady turns, the kinematic limit, and an independent integration."""

import math

import numpy as np
import pytest

from monstertruck_kinematics.dynamics import SingleTrack
from monstertruck_kinematics.elementary import KinematicsError
from monstertruck_kinematics.truck import FourWheelSteering

NEUTRAL = SingleTrack()
UNDERSTEER = SingleTrack(FourWheelSteering(cg_split=0.4), front_stiffness=100.0, rear_stiffness=140.0)


def settled(model, speed, front, rear, dt=0.01, steps=500):
    twist = (0.0, 0.0, 0.0)
    for _ in range(steps):
        twist = model.step(twist, speed, front, rear, dt)
    return twist


def understeer_gradient(model):
    """K in the steady turn w = v_x (d_f - d_r)/(L + K v_x^2), small angles, s^2/m; above 0 understeers."""
    front, rear, geometry = model.front_stiffness, model.rear_stiffness, model.geometry
    return model.mass * (geometry.l_r * rear - geometry.l_f * front) / (geometry.wheelbase * front * rear)


@pytest.mark.parametrize("speed", [1.0, 2.0])
@pytest.mark.parametrize("model", [NEUTRAL, UNDERSTEER], ids=["neutral", "understeer"])
def test_steady_turn_has_the_textbook_yaw_rate(model, speed):
    front, rear = 0.01, -0.004
    gain = model.geometry.wheelbase + understeer_gradient(model) * speed**2
    assert settled(model, speed, front, rear)[2] == pytest.approx(speed * (front - rear) / gain, rel=1e-3)


def test_creeping_is_kinematic_at_once():
    model = NEUTRAL
    for speed in (0.04, -0.04, 0.0):
        twist = model.step((0.0, 0.3, -0.5), speed, 0.3, -0.2, 0.001)
        assert twist == pytest.approx(model.geometry.body_twist(speed, 0.3, -0.2), abs=1e-15)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_slow_turns_approach_the_kinematic_ones(sign):
    twist = settled(NEUTRAL, sign * 0.2, 0.3, -0.2)
    rolled = NEUTRAL.geometry.body_twist(sign * 0.2, 0.3, -0.2)
    assert twist[2] == pytest.approx(rolled[2], rel=1e-3)
    assert twist[1] == pytest.approx(rolled[1], abs=1e-3)
    assert twist[2] * sign > 0.0


def test_step_follows_the_differential_equation():
    vx = UNDERSTEER.geometry.body_twist(2.0, 0.1, 0.0)[0]
    state, h = np.zeros(2), 1e-4

    def f(x):
        return np.array(UNDERSTEER.rates(np.array(vx), x[0], x[1], np.array(0.1), np.array(0.0)))

    for _ in range(1000):
        k1 = f(state)
        k2 = f(state + h / 2 * k1)
        k3 = f(state + h / 2 * k2)
        state = state + h / 6 * (k1 + 2 * k2 + 2 * k3 + f(state + h * k3))
    twist = (0.0, 0.0, 0.0)
    for _ in range(100):
        twist = UNDERSTEER.step(twist, 2.0, 0.1, 0.0, 0.001)
    assert twist == pytest.approx((vx, *state), abs=1e-6)


def test_any_step_is_stable(rng):
    twist = tuple(rng.uniform(-0.1, 0.1, (3, 200)))
    speed, front, rear = rng.uniform(-0.3, 0.3, 200), rng.uniform(-0.4, 0.4, 200), rng.uniform(-0.4, 0.4, 200)
    for _ in range(20):
        twist = NEUTRAL.step(twist, speed, front, rear, 0.5)
    assert np.abs(twist).max() < 1.0
    one = NEUTRAL.step(tuple(float(c[3]) for c in twist), float(speed[3]), float(front[3]), float(rear[3]), 0.5)
    many = NEUTRAL.step(twist, speed, front, rear, 0.5)
    assert one == pytest.approx([float(c[3]) for c in many], abs=1e-14)


def test_blend_has_no_jump():
    speeds = np.linspace(0.0, 0.3, 3001)
    twist = (0.0 * speeds, 0.0 * speeds, 0.0 * speeds)
    _, vy, wz = NEUTRAL.step(twist, speeds, 0.0 * speeds + 0.3, 0.0 * speeds, 0.005)
    assert np.abs(np.diff(wz)).max() < 2e-3
    assert np.abs(np.diff(vy)).max() < 2e-3


def test_bad_dynamics_are_named():
    for changes, field in (
        ({"mass": 0.0}, "mass"),
        ({"yaw_inertia": -1.0}, "yaw_inertia"),
        ({"front_stiffness": math.nan}, "front_stiffness"),
        ({"blend_from": 0.2}, "blend_to"),
    ):
        with pytest.raises(KinematicsError, match=field):
            SingleTrack(**changes)
    with pytest.raises(KinematicsError, match="vy is nan"):
        NEUTRAL.step((0.0, math.nan, 0.0), 0.1, 0.0, 0.0, 0.01)
    with pytest.raises(KinematicsError, match="dt is 0"):
        NEUTRAL.step((0.0, 0.0, 0.0), 0.1, 0.0, 0.0, 0.0)
