"""Terrain: ground height, beam intersections and the resulting body tilt; also an oscillating tilt."""

from dataclasses import dataclass
from itertools import pairwise
from math import atan, cos, pi, radians, sin
from pathlib import Path
from typing import Any

import numpy as np

from monstertruck_kinematics.elementary import Array
from monstertruck_runtime.errors import InputError
from monstertruck_runtime.yaml_files import read_yaml, yaml_text
from monstertruck_sim.world.config import RoughPatch, SinusoidTilt


@dataclass(frozen=True, slots=True)
class Profile:
    """Ground height along x, the same for every y, interpolated linearly between points.

    Args:
        points: (x, z) in the map frame (m), with increasing x; the height is constant beyond the ends.
    """

    points: tuple[tuple[float, float], ...]

    def height(self, x: Array) -> Array:
        """Return the heights (m) in the shape of ``x``."""
        return np.asarray(np.interp(x, [p[0] for p in self.points], [p[1] for p in self.points]))


LEVEL = Profile(((0.0, 0.0), (1.0, 0.0)))


class Terrain:
    """Ground height over the plane.

    Args:
        profile: profile along x.
        patches: patches of rough ground.
    """

    def __init__(self, profile: Profile, patches: tuple[RoughPatch, ...]) -> None:
        self._profile, self._patches = profile, patches

    def height(self, x: Array, y: Array) -> Array:
        """Return the heights at points in the map frame (m); all arrays have the same shape."""
        z = self._profile.height(x)
        for patch in self._patches:
            dx, dy = x - patch.x, y - patch.y
            inside = (abs(dx) < patch.length / 2) & (abs(dy) < patch.width / 2)
            wave = 2 * pi / patch.wavelength
            z = z + np.where(inside, patch.height / 2 * (np.sin(wave * dx) + np.sin(wave * dy)), 0.0)
        return z

    def tilt(self, x: float, y: float, yaw: float, wheelbase: float, track: float) -> tuple[float, float]:
        """Return pitch (nose down positive) and roll (right side down positive) of a body on four wheels (rad)."""
        along, across = np.array((1, 1, -1, -1)) * wheelbase / 2, np.array((1, -1, 1, -1)) * track / 2
        c, s = np.cos(yaw), np.sin(yaw)
        fl, fr, rl, rr = self.height(x + c * along - s * across, y + s * along + c * across).tolist()
        return -atan((fl + fr - rl - rr) / 2 / wheelbase), atan((fl + rl - fr - rr) / 2 / track)

    def cast(self, xs: Array, ys: Array, zs: Array, headings: Array, rises: Array, reach: float) -> Array:
        """Return the horizontal distances at which beams hit the ground; inf without a hit within ``reach``.

        Args:
            xs: x of the origins, (n,) (m).
            ys: y of the origins.
            zs: z of the origins.
            headings: directions in the plane, (n,) (rad).
            rises: rise per metre of horizontal distance, (n,).
            reach: maximum horizontal distance (m).
        """
        step = 0.05  # horizontal distance between two samples along a beam, m
        ways = np.arange(0.0, reach + step, step)
        x = xs[:, None] + np.cos(headings)[:, None] * ways
        y = ys[:, None] + np.sin(headings)[:, None] * ways
        above = zs[:, None] + rises[:, None] * ways - self.height(x, y)
        first = np.argmax(above < 0.0, axis=1)
        beams = np.arange(len(xs))
        before, after = above[beams, first - 1], above[beams, first]
        with np.errstate(divide="ignore", invalid="ignore"):
            met = ways[first] - step * after / (after - before)
        return np.where(above[beams, first] < 0.0, np.where(first > 0, met, 0.0), np.inf)


def rocking(config: SinusoidTilt, elapsed_ns: int) -> tuple[float, float]:
    """Return pitch and roll (rad) ``elapsed_ns`` after the start of the world."""
    phase = 2 * pi * config.frequency * elapsed_ns * 1e-9
    return radians(config.pitch_deg) * sin(phase), -radians(config.roll_deg) * cos(phase)


def profile_path(map_path: Path) -> Path:
    """Return the path of a map's ground profile, whether or not it exists."""
    return map_path.with_suffix(".profile.yaml")


def load_profile(path: Path) -> Profile:
    """Read ``points: [[x, z], ...]``.

    Raises:
        InputError: the file is invalid; the message names the file and the key.
    """
    keys = read_yaml(path)
    points: Any = keys.get("points") if isinstance(keys, dict) else None
    try:
        pairs = tuple((float(x), float(z)) for x, z in points)
    except (TypeError, ValueError) as error:
        raise InputError(f"{path}: points: expected a list of [x, z] in metres") from error
    if len(pairs) < 2 or any(b[0] <= a[0] for a, b in pairwise(pairs)):
        raise InputError(f"{path}: points: expected at least two points with increasing x")
    return Profile(pairs)


def save_profile(profile: Profile, path: Path) -> None:
    """Write a file that ``load_profile`` can read."""
    path.write_text(yaml_text({"points": [list(p) for p in profile.points]}), encoding="utf-8")
