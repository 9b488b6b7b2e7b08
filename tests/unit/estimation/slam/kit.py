"""A flat world of walls, a lidar in it, and wheels that drift."""

import itertools
import math

import numpy as np

from monstertruck_estimation.slam.config import MapperConfig
from monstertruck_estimation.slam.keyframes import KeyframeMap
from monstertruck_estimation.slam.mapping import Mapper, Step
from monstertruck_estimation.slam.scans import Scan, ScanGeometry, prepare
from monstertruck_kinematics.se2 import between, compose
from monstertruck_runtime.clock import SECOND

BEAMS = 240
LIDAR = ScanGeometry(-math.radians(120), math.radians(240) / (BEAMS - 1), 0.02, 5.6)


def box(x0, y0, x1, y1):
    return [((x0, y0), (x1, y0)), ((x1, y0), (x1, y1)), ((x1, y1), (x0, y1)), ((x0, y1), (x0, y0))]


ROOM = [
    *box(-3.0, -2.0, 3.0, 2.5),
    *box(-1.0, -0.6, 1.0, 0.7),
    *box(2.2, 1.7, 3.0, 2.5),
    *box(-3.0, -2.0, -2.4, -1.2),
    *box(0.3, 2.2, 0.7, 2.5),
]
CORRIDOR = [((-50.0, -1.0), (50.0, -1.0)), ((-50.0, 1.0), (50.0, 1.0))]


def ranges(walls, pose, geometry=LIDAR, beams=BEAMS, noise=0.0, rng=None):
    """Exact ranges by intersection of every beam with every wall, inf where none is hit.

    ``pose`` is the base's, shape (3,), or its own for every beam, shape (beams, 3).
    """
    sensor = compose(np.broadcast_to(np.asarray(pose, float), (beams, 3)), np.array(geometry.mount))
    angles = sensor[:, 2] + geometry.start_angle + geometry.angle_increment * np.arange(beams)
    ways = np.stack((np.cos(angles), np.sin(angles)), axis=1)[:, None]
    a = np.array([wall[0] for wall in walls])[None] - sensor[:, None, :2]
    along = (np.array([wall[1] for wall in walls]) - np.array([wall[0] for wall in walls]))[None]
    cross = ways[..., 0] * along[..., 1] - ways[..., 1] * along[..., 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        far = (a[..., 0] * along[..., 1] - a[..., 1] * along[..., 0]) / cross
        share = (a[..., 0] * ways[..., 1] - a[..., 1] * ways[..., 0]) / cross
    hit = (np.abs(cross) > 1e-12) & (far > 0) & (share >= 0) & (share <= 1)
    result = np.where(hit, far, np.inf).min(axis=1)
    if rng is not None:
        result = result + rng.normal(0.0, noise, beams)
    return np.where(result < geometry.range_max, result, np.inf)


def scan(walls, pose, **kwargs) -> Scan:
    return prepare(ranges(walls, pose, **kwargs), LIDAR)


def rounds(count, laps=1.0, width=2.0, height=1.4):
    """Poses, shape (count, 3), along an ellipse about the middle of ROOM, facing ahead; the first is the start."""
    angle = np.linspace(0, 2 * math.pi * laps, count) - math.pi / 2
    x, y = width * np.cos(angle), height * np.sin(angle)
    yaw = np.arctan2(height * np.cos(angle), -width * np.sin(angle))
    return np.stack((x, y, yaw), axis=1)


def drifting(truth, turn=0.02, scale=1.05):
    """Odometry of ``truth``: ways too long by ``scale``, turned by ``turn`` rad per metre."""
    poses = [np.zeros(3)]
    for before, after in itertools.pairwise(truth):
        delta = between(before, after)
        delta[:2] *= scale
        delta[2] += turn * math.hypot(delta[0], delta[1])
        poses.append(compose(poses[-1], delta))
    return np.array(poses)


def drive(mapper: Mapper, walls, truth, odom, *, noise=0.01, seed=1) -> list[Step | None]:
    """Every pose's scan through the mapper, ten a second."""
    rng = np.random.default_rng(seed)
    return [
        mapper.step(scan(walls, pose, noise=noise, rng=rng), int(k * 1e8), None if odom is None else odom[k])
        for k, pose in enumerate(truth)
    ]


def errors(poses, truth):
    """Distances, m, between poses reported from the first one."""
    off = between(truth[0], np.asarray(truth)) - between(poses[0], np.asarray(poses))
    return np.hypot(off[:, 0], off[:, 1])


POSTS = ((-4.0, 2.6), (-1.2, 3.1), (2.0, 2.4), (4.4, 0.9), (3.6, -2.4), (0.4, -3.0), (-2.6, -2.7), (-4.6, -0.4))
HALL = [
    *box(-6.0, -4.2, 6.0, 4.0),
    *box(-1.5, -0.8, 1.7, 0.6),
    *(wall for x, y in POSTS for wall in box(x, y, x + 0.3 + 0.07 * abs(x), y + 0.3 + 0.1 * abs(y))),
]
WAY = rounds(200, 1.0, 3.6, 2.2)[::4]
"""Where keyframes are in the hall, 0.4 m apart."""
SURE = np.diag((0.02**2, 0.02**2, 0.004**2))


def extend(keyframes, poses, begin=None):
    """Add keyframes at ``poses`` in the hall, one by one; the first at ``begin``, in a submap of its own.

    Without ``begin`` the first is that of the newest keyframe.
    """
    rng = np.random.default_rng(len(keyframes))
    for k, pose in enumerate(poses):
        known, stamp = scan(HALL, pose, noise=0.01, rng=rng), len(keyframes) * SECOND
        if k == 0 and begin is not None:
            keyframes.add(known, stamp, np.array(begin), apart=True)
        elif k:
            delta = between(poses[k - 1], pose)
            keyframes.add(known, stamp, compose(keyframes.poses[-1], delta))
            keyframes.add_odometry_edge(delta, SURE)
        yield len(keyframes)


def consume(steps):
    for _ in steps:
        pass


def submaps(*stretches):
    """Keyframes of several stretches of ``WAY``, each in a submap of its own."""
    keyframes = KeyframeMap(MapperConfig())
    for k, stretch in enumerate(stretches):
        consume(extend(keyframes, WAY[stretch], (7.0 * k, 3.0 * k, 0.4 * k)))
    return keyframes
