"""Search for tags on walls: wall faces that the camera has not yet viewed from near enough and not too obliquely.

A layer over exploration: once no frontier is left, the robot drives past the walls until the requested number of tags
is found, or every wall has been viewed.
"""

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from monstertruck_kinematics.elementary import Array
from monstertruck_kinematics.se2 import Pose2
from monstertruck_planners.collision import OCCUPIED
from monstertruck_planners.explore.api import ExplorationView
from monstertruck_planners.explore.exchange import CameraView, Viewpoint
from monstertruck_planners.explore.frontier import FrontierMap
from monstertruck_planners.explore.kernels import shares_seen

FACE: Final = 0.2
"""Side of the squares (m) that, with eight directions, distinguish wall faces."""
NEAR_BANNED: Final = 0.3
"""Faces within this distance of a banned place are skipped (m)."""


@dataclass(frozen=True)
class Faces:
    """Wall faces next to free ground."""

    points: Array
    """Points in front of the wall (m), shape (n, 2)."""
    normals: Array
    """Unit vectors away from the wall, shape (n, 2)."""
    keys: NDArray[np.int64]
    """Square and direction, shape (n,)."""


class WallLooks:
    """Wall faces that the camera has viewed.

    Args:
        camera: camera of the robot.
    """

    def __init__(self, camera: CameraView) -> None:
        self._camera = camera
        self._looked: set[int] = set()

    def take(self, known: FrontierMap, pose: Pose2) -> None:
        """Mark the faces in front of the camera at this pose as viewed."""
        faces = faces_of(known)
        if len(faces.keys):
            self._looked.update(faces.keys[self._sees(known, faces, pose)].tolist())

    def choose(self, view: ExplorationView, current: Viewpoint | None) -> Viewpoint | None:
        """Return a viewpoint of a wall; the current one until its wall has been viewed."""
        faces = faces_of(view.known)
        open_ = ~np.isin(faces.keys, np.fromiter(self._looked, np.int64, len(self._looked)))
        for place in view.banned:
            open_ &= np.hypot(*(faces.points - place).T) > NEAR_BANNED
        left = np.flatnonzero(open_)
        if not len(left):
            return None
        if current is not None and np.hypot(*(faces.points[left] - current.frontier).T).min() < FACE / 2:
            return current
        best, least = None, math.inf
        worth = 1.5  # cost of a look besides its path (m)
        # 60: maximum number of evenly sampled faces to search a viewpoint for
        for i in left[np.unique(np.linspace(0, len(left) - 1, 60).astype(np.intp))]:
            pose = self._place(view, faces.points[i], faces.normals[i])
            length = None if pose is None else view.path_length_to(pose[:2])
            if pose is None or length is None:
                continue
            gain = int(np.count_nonzero(self._sees(view.known, faces, pose) & open_))
            if gain and (length + worth) / gain < least:
                x, y = faces.points[i].tolist()
                best, least = Viewpoint(pose, (x, y), length, gain * FACE), (length + worth) / gain
        return best

    def _place(self, view: ExplorationView, point: Array, normal: Array) -> Pose2 | None:
        """Return a free pose of the robot with the face in front of its camera."""
        mx, my, turn = self._camera.mount
        for aside in (0.0, 0.5, -0.5):  # viewing angles from the face normal (rad)
            c, s = math.cos(aside), math.sin(aside)
            ahead = np.array((c * normal[0] - s * normal[1], s * normal[0] + c * normal[1]))
            for away in (0.8, 1.0, 0.65):  # viewing distances (m); the first free one is used
                yaw = math.atan2(-ahead[1], -ahead[0]) - turn
                c0, s0 = math.cos(yaw), math.sin(yaw)
                x, y = (point + away * ahead - (c0 * mx - s0 * my, s0 * mx + c0 * my)).tolist()
                pose = (x, y, math.remainder(yaw, math.tau))
                if any(math.dist(pose[:2], place) < NEAR_BANNED for place in view.avoided):
                    continue
                if view.free(np.array([pose]))[0]:
                    return pose
        return None

    def _sees(self, known: FrontierMap, faces: Faces, pose: Pose2) -> NDArray[np.bool_]:
        """Return which faces the camera sees with the robot at a pose."""
        camera, (mx, my, turn) = self._camera, self._camera.mount
        c, s = math.cos(pose[2]), math.sin(pose[2])
        eye = np.array((pose[0] + c * mx - s * my, pose[1] + s * mx + c * my))
        off = faces.points - eye
        away = np.hypot(*off.T)
        bearing = np.arctan2(off[:, 1], off[:, 0]) - pose[2] - turn
        inside = np.abs((bearing + np.pi) % (2 * np.pi) - np.pi) < camera.view / 2
        front = -(off * faces.normals).sum(axis=1) >= np.maximum(away, 1e-6) * math.cos(camera.oblique)
        seen: NDArray[np.bool_] = inside & front & (away < camera.reach) & (away > camera.nearest)
        at = np.flatnonzero(seen)
        if len(at):
            corner, cell = np.array(known.origin[:2]), known.resolution
            clear = shares_seen(
                known.cells, (faces.points[at] - corner) / cell, ((eye - corner) / cell)[None], camera.reach / cell
            )
            seen[at] = clear > 0
        return seen


def faces_of(known: FrontierMap) -> Faces:
    """Return the wall faces next to free ground: one for each square of ``FACE`` and direction."""
    solid = known.cells >= OCCUPIED
    padded = np.pad(solid, 1).astype(np.int8)
    rows, columns = known.cells.shape

    def neighbour(dx: int, dy: int) -> NDArray[np.int8]:
        return padded[1 + dy : 1 + dy + rows, 1 + dx : 1 + dx + columns]

    beside = (neighbour(1, 0) | neighbour(-1, 0) | neighbour(0, 1) | neighbour(0, -1)) > 0
    row, column = np.nonzero(beside & (known.cells >= 0) & ~solid)
    # Sobel's kernel: away from the wall.
    x = 2 * (neighbour(-1, 0) - neighbour(1, 0)) + sum(neighbour(-1, k) - neighbour(1, k) for k in (-1, 1))
    y = 2 * (neighbour(0, -1) - neighbour(0, 1)) + sum(neighbour(k, -1) - neighbour(k, 1) for k in (-1, 1))
    normals = np.stack((x[row, column], y[row, column]), axis=-1).astype(np.float64)
    length = np.hypot(*normals.T)
    kept = length > 0
    normals = normals[kept] / length[kept, None]
    points = (np.stack((column, row), axis=-1)[kept] + 0.5) * known.resolution + known.origin[:2]
    square = np.floor(points / FACE).astype(np.int64)
    eighth = np.rint(np.arctan2(normals[:, 1], normals[:, 0]) / (math.pi / 4)).astype(np.int64) % 8
    keys = ((square[:, 0] + 2**20) * 2**21 + square[:, 1] + 2**20) * 8 + eighth
    keys, first = np.unique(keys, return_index=True)
    return Faces(points[first], normals[first], keys)
