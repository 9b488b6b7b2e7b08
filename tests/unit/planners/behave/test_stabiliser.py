"""Levelling: the geometry of the mount, limits and rates, prediction, and what is done without a tilt."""

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from monstertruck_estimation.body_tilt import Tilt
from monstertruck_planners.behave.stabiliser import (
    SQUARE,
    Joints,
    StabiliserConfig,
    StabiliserService,
    TiltFilter,
    goals,
    level,
)
from monstertruck_runtime.clock import SECOND, VirtualClock, run_virtual
from monstertruck_runtime.mailbox import Mailbox, fifo, latest
from monstertruck_schemas.plan import StabiliserCommand
from monstertruck_schemas.sensor import Attitude
from monstertruck_schemas.state import Odometry
from tests.unit.drivers.kit import background
from tests.unit.estimation.kit import felt_tilt
from tests.unit.planners.behave.wall_kit import odometry

CONFIG = StabiliserConfig()
angles = st.floats(-1.2, 1.2)


def rx(angle: float):
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[1, 0, 0], [0, c, -s], [0, s, c]])


def ry(angle: float):
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])


def attitude(seconds: float, roll: float = 0.0, pitch: float = 0.0, *, valid: bool = True) -> Attitude:
    stamp = round(seconds * SECOND)
    return Attitude(stamp=stamp, received=stamp, seq=0, heading=0.0, roll=roll, pitch=pitch, tilt_valid=valid)


@given(angles, angles)
def test_the_joints_level_the_lidar(roll: float, pitch: float):
    joints = level(Tilt(roll, pitch))
    up = ry(pitch) @ rx(roll) @ ry(joints.pitch) @ rx(joints.roll) @ np.array([0, 0, 1])
    assert up == pytest.approx(np.array([0, 0, 1]), abs=1e-9)


def test_signs_and_the_heading_that_remains():
    assert level(Tilt(0.0, 0.2)) == pytest.approx(Joints(-0.2, 0.0)), "nose down: the mount pitches up"
    assert level(Tilt(0.2, 0.0)) == pytest.approx(Joints(0.0, -0.2))
    tilt = math.radians(15)
    joints = level(Tilt(tilt, tilt))
    forward = ry(tilt) @ rx(tilt) @ ry(joints.pitch) @ rx(joints.roll) @ np.array([1, 0, 0])
    assert abs(math.degrees(math.atan2(forward[1], forward[0]))) == pytest.approx(4, abs=0.2)


@given(st.none() | st.builds(Tilt, angles, angles), st.floats(-0.52, 0.52), st.floats(-0.52, 0.52))
def test_goals_keep_limits_and_rate(tilt: Tilt | None, pitch: float, roll: float):
    config = StabiliserConfig(pitch_limit=0.52, roll_limit=0.3, max_rate=1.0)
    before = Joints(pitch, min(max(roll, -0.3), 0.3))
    after = goals(tilt, before, 0.02, config)
    assert abs(after.pitch) <= 0.52
    assert abs(after.roll) <= 0.3
    assert abs(after.pitch - before.pitch) <= 0.02 + 1e-12
    assert abs(after.roll - before.roll) <= 0.02 + 1e-12


def test_goals_arrive_and_without_tilt_return_to_zero():
    joints = SQUARE
    for _ in range(50):
        joints = goals(Tilt(0.1, -0.2), joints, 0.02, CONFIG)
    assert joints == level(Tilt(0.1, -0.2))
    for _ in range(50):
        joints = goals(None, joints, 0.02, CONFIG)
    assert joints == SQUARE


def test_the_filter_knows_constant_acceleration():
    tilt = TiltFilter(CONFIG)
    times = 1 + np.cumsum([0.05, 0.05, 0.04, 0.06] * 20)
    for t in times:
        tilt.observe(attitude(float(t), roll=0.1 * t**2, pitch=0.3 - 0.2 * t))
    now = float(times[-1]) + 0.05
    ahead = now + CONFIG.lead
    expected = Tilt(0.1 * ahead**2, 0.3 - 0.2 * ahead)
    assert tilt.tilt(round(now * SECOND)) == pytest.approx(expected, abs=1e-4)


def test_prediction_ends_and_readings_get_stale():
    tilt = TiltFilter(CONFIG)
    assert tilt.tilt(SECOND) is None
    for i in range(40):
        tilt.observe(attitude(1 + 0.05 * i, pitch=0.05 * i))
    newest = 1 + 0.05 * 39
    predicted = [
        tilt.tilt(round((newest + age) * SECOND))
        for age in (0.1, CONFIG.coast, CONFIG.stale_after - 0.01, CONFIG.stale_after + 0.01)
    ]
    assert predicted[0].pitch == pytest.approx(0.05 * 39 + 0.1 + CONFIG.lead, abs=1e-6)
    assert predicted[1] == predicted[2]
    assert predicted[3] is None


def test_invalid_and_old_readings_are_passed_over():
    tilt = TiltFilter(CONFIG)
    for i in range(10):
        tilt.observe(attitude(1 + 0.05 * i, roll=0.1))
    before = tilt.tilt(round(1.5 * SECOND))
    tilt.observe(attitude(1.49, roll=0.9, valid=False))
    tilt.observe(attitude(1.45, roll=0.9))
    tilt.observe(attitude(1.2, roll=0.9))
    assert tilt.tilt(round(1.5 * SECOND)) == before


def test_after_a_gap_the_filter_starts_anew():
    tilt = TiltFilter(CONFIG)
    for i in range(10):
        tilt.observe(attitude(1 + 0.05 * i, pitch=0.05 * i))
    tilt.observe(attitude(5.0, roll=0.1, pitch=-0.1))
    assert tilt.tilt(5 * SECOND) == pytest.approx(Tilt(0.1, -0.1))


def followed(rocking: float, noise: float) -> float:
    """RMS of what is predicted too much or too little, rad, of a body that rocks at 0.5 Hz; angles in rad."""
    tilt, rng, off = TiltFilter(CONFIG), np.random.default_rng(1), []

    def body(t):
        return rocking * math.sin(math.pi * t)

    for i in range(400):
        t = 1 + 0.05 * i
        tilt.observe(attitude(t, pitch=body(t) + noise * rng.standard_normal()))
        if i > 100:
            off.append(tilt.tilt(round((t + 0.05) * SECOND)).pitch - body(t + 0.05 + CONFIG.lead))
    return float(np.sqrt(np.mean(np.square(off))))


def test_it_is_calm_on_smooth_ground_and_quick_where_the_body_rocks():
    assert followed(0.0, 0.01) < 0.012, "the quickest filter alone makes 0.03 of it"
    assert followed(0.26, 0.002) < 0.02, "the calmest filter alone would be off by 0.1"


class Kept:
    def __init__(self) -> None:
        self.kept: list[StabiliserCommand] = []

    def next_seq(self) -> int:
        return len(self.kept)

    def put(self, message: StabiliserCommand) -> None:
        self.kept.append(message)


def serving(test: Any, with_odometry: bool = False) -> None:
    """Run ``test(clock, compass, out)``, or with the odometry as well, with the service running."""

    async def main(clock: VirtualClock) -> None:
        compass: Mailbox[Attitude] = Mailbox(latest())
        moved: Mailbox[Odometry] = Mailbox(fifo(64))
        out = Kept()
        ready: list[int] = []
        service = StabiliserService(CONFIG, clock, compass, moved, out)
        async with background(service.run(lambda: ready.append(clock.now()))):
            await (test(clock, compass, out, moved) if with_odometry else test(clock, compass, out))
        assert len(ready) == 1

    run_virtual(main)


def test_the_service_publishes_at_its_rate_and_follows_the_compass():
    async def test(clock, compass, out) -> None:
        for i in range(40):
            now = clock.now() / SECOND
            compass.put(attitude(now, roll=0.1, pitch=-0.2))
            await clock.sleep(0.05)
            assert len(out.kept) == pytest.approx(1.25 * (i + 1), abs=1)
        newest = out.kept[-1]
        assert (newest.pitch, newest.roll) == pytest.approx(level(Tilt(0.1, -0.2)), abs=1e-6)
        assert [message.seq for message in out.kept] == list(range(len(out.kept)))
        assert newest.stamp == newest.received

    serving(test)


def test_the_service_returns_to_zero_when_tilt_stops_counting():
    async def test(clock, compass, out) -> None:
        for valid in (True, False):
            for _ in range(20):
                compass.put(attitude(clock.now() / SECOND, roll=0.1, pitch=-0.2, valid=valid))
                await clock.sleep(0.05)
            newest = out.kept[-1]
            assert (newest.pitch, newest.roll) == pytest.approx(level(Tilt(0.1, -0.2)) if valid else SQUARE, abs=1e-6)
        compass.put(attitude(clock.now() / SECOND, roll=0.1))
        await clock.sleep(0.2)
        assert out.kept[-1].roll == pytest.approx(-0.1, abs=1e-6)
        await clock.sleep(1.0)
        assert out.kept[-1].roll == 0.0, "the compass fell silent"

    serving(test)


def swing(*, with_odometry: bool) -> float:
    """Greatest joint angle, degrees, of a level truck that sets off and whose accelerometer has a filter of 50 ms."""
    found = []

    async def test(clock, compass, out, moved) -> None:
        speed = felt = 0.0
        for i in range(150):
            before, speed = speed, min(max(i - 50, 0) * 0.02 * 0.9, 0.2)
            felt += ((speed - before) / 0.02 - felt) * 0.02 / 0.05
            now = clock.now()
            if with_odometry:
                moved.put(odometry(vx=speed, now=now))
            if i % 2 == 0:
                measured = felt_tilt(felt, 0.0, 0.0, 0.0)
                compass.put(attitude(now / SECOND, roll=measured.roll, pitch=measured.pitch))
            await clock.sleep(0.02)
        found.extend(math.degrees(abs(message.pitch)) for message in out.kept)

    serving(test, with_odometry=True)
    return max(found)


def test_a_level_truck_that_sets_off_keeps_its_lidar_level():
    assert swing(with_odometry=True) < swing(with_odometry=False) / 2
