"""Poses of tags in base: how accurate they are, and that their covariances say so."""

import math

import numpy as np
import pytest

from monstertruck_drivers.webcam.emulator import jpeg
from monstertruck_estimation.points.exchange import ReadTask, tag_pose
from monstertruck_estimation.points.reader import ReadingStep
from monstertruck_kinematics.se2 import between
from monstertruck_schemas.body import LensConfig, Mount
from monstertruck_sim.world.camera import Painter, mounted, tag_panel
from monstertruck_sim.world.config import CameraConfig, TagConfig

MOUNT = Mount(x=0.18, z=0.25)
TAG = np.array((1.0, 0.0, math.pi))
"""In map."""


def errors(distance: float, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Errors (n, 3) of poses in base, and their covariances (n, 3, 3), of a tag of 20 cm before the camera."""
    lens, rng, step = CameraConfig(), np.random.default_rng(1), ReadingStep()
    painter = Painter(lens, (640, 480), 0.6)
    off, spread = [], []
    for _ in range(count):
        base = (TAG[0] - distance - MOUNT.x, rng.normal(0, 0.03), rng.normal(0, 0.05))
        tag = TagConfig(tag=3, x=TAG[0], y=TAG[1], yaw=TAG[2], size=0.2)
        image = painter.picture(np.full(len(painter.azimuths), 6.0), [tag_panel(tag)], mounted(base, lens))
        data = jpeg(np.clip(image + rng.normal(0, 3.0, image.shape), 0, 255).astype(np.uint8), 1)
        (reading,) = step.step(ReadTask(data, LensConfig(), 0.2)).readings
        pose = tag_pose(reading, MOUNT)
        error = np.array((pose.x, pose.y, pose.yaw)) - between(np.array(base), TAG)
        off.append((*error[:2], math.remainder(error[2], math.tau)))
        spread.append(pose.covariance.reshape(3, 3))
    return np.array(off), np.array(spread)


def test_a_tag_seen_from_its_front_has_an_accurate_heading_near_by():
    off, spread = errors(0.42, 20)
    heading = np.degrees(np.sqrt((off[:, 2] ** 2).mean()))
    assert heading < 0.5  # 1.2 degrees without the refinement of both poses
    assert np.abs(off[:, :2]).max() < 0.003
    assert np.degrees(np.sqrt(spread[:, 2, 2].mean())) == pytest.approx(heading, rel=1.0)


def test_the_errors_are_as_large_as_the_covariances_say():
    off, spread = errors(1.2, 20)
    mahalanobis = np.einsum("ni,nij,nj->n", off, np.linalg.inv(spread), off)
    assert mahalanobis.mean() < 3 * 2
    assert spread[:, 0, 0].mean() > (2 * np.abs(off[:, 0]).mean() / 5) ** 2
