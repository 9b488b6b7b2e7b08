"""Lidar on a mount with joints, and the camera's view, in a rocking world."""

import math

import numpy as np
import pytest

from monstertruck_runtime.clock import SECOND
from monstertruck_sim.world.config import SinusoidTilt, WorldConfig
from monstertruck_sim.world.world import World


class Joints:
    """A mount that stands still."""

    def __init__(self, pitch: float, roll: float) -> None:
        self._angles = (pitch, roll)

    def angles(self, times_ns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        pitch, roll = (np.full(times_ns.shape, angle) for angle in self._angles)
        return pitch, roll


def tilted_world(pitch_deg: float) -> World:
    """Nose down by a slowly moving angle, at its greatest a quarter period after the start."""
    tilt = SinusoidTilt(kind="sinusoid", pitch_deg=pitch_deg, frequency=0.5)
    return World(WorldConfig(noise=False, tilt=tilt), 1)


def scan_at_the_top(world: World) -> np.ndarray:
    world.truth(0)
    for step in range(1, 101):
        world.truth(step * SECOND // 200)
    return world.lidar.scan(SECOND // 2 - SECOND // 20)


def test_a_mount_that_turns_back_makes_the_scan_level():
    level = scan_at_the_top(tilted_world(0.0)).astype(float)
    bare = scan_at_the_top(tilted_world(10.0)).astype(float)
    world = tilted_world(10.0)
    world.carry_lidar(Joints(-math.radians(10.0), 0.0))
    held = scan_at_the_top(world).astype(float)
    seen = (level > 20) & (held > 20)
    assert seen.sum() > 500
    assert np.abs(held - level)[seen].mean() < 0.2 * np.abs(bare - level)[seen].mean()


def test_a_mount_tilts_a_lidar_on_a_level_truck():
    world = tilted_world(0.0)
    world.carry_lidar(Joints(math.radians(15.0), 0.0))
    ahead = scan_at_the_top(world)[384]
    assert ahead == pytest.approx(250 / math.sin(math.radians(15.0)), abs=2)


def test_the_camera_sees_what_the_lidar_sees():
    world = tilted_world(0.0)
    lidar = scan_at_the_top(world)[384 - 50 : 384 + 51].astype(float) / 1000
    angles = (np.arange(101) - 50) * 2 * math.pi / 1024
    view = world.view.ranges(SECOND // 2, angles)
    config = WorldConfig()
    assert view[50] == pytest.approx(lidar[50] + config.lidar.x - config.camera.x, abs=0.003)
    assert np.isfinite(view).all()
