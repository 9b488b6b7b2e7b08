"""Tilt of the body: from the ground's height under its wheels, or rocking with time."""

from dataclasses import dataclass
from itertools import pairwise
from math import atan, cos, pi, radians, sin
from pathlib import Path
from typing import Any

import numpy as np

from monstertruck_runtime.errors import InputError
from monstertruck_runtime.yaml_files import read_yaml, yaml_text
from monstertruck_sim.world.config import SinusoidTilt


@dataclass(frozen=True, slots=True)
class Profile:
    """Height of the ground along x, the same for every y: straight lines between points.

    Args:
        points: (x, z) in the map frame, m, x rising; constant beyond the ends.
    """

    points: tuple[tuple[float, float], ...]

    def height(self, x: float) -> float:
        """Metres."""
        return float(np.interp(x, [p[0] for p in self.points], [p[1] for p in self.points]))

    def tilt(self, x: float, yaw: float, wheelbase: float, track: float) -> tuple[float, float]:
        """Pitch (nose down positive) and roll (right side down positive) of a body on four wheels, rad."""
        forward, left = cos(yaw), -sin(yaw)
        rise = self.height(x + forward * wheelbase / 2) - self.height(x - forward * wheelbase / 2)
        lean = self.height(x + left * track / 2) - self.height(x - left * track / 2)
        return -atan(rise / wheelbase), atan(lean / track)


def rocking(config: SinusoidTilt, elapsed_ns: int) -> tuple[float, float]:
    """Pitch and roll, rad, ``elapsed_ns`` after the world's start."""
    phase = 2 * pi * config.frequency * elapsed_ns * 1e-9
    return radians(config.pitch_deg) * sin(phase), -radians(config.roll_deg) * cos(phase)


def profile_path(map_path: Path) -> Path:
    """Where the ground profile of a map lies, if it has one."""
    return map_path.with_suffix(".profile.yaml")


def load_profile(path: Path) -> Profile:
    """Read ``points: [[x, z], ...]``.

    Raises:
        InputError: naming file and key.
    """
    keys = read_yaml(path)
    points: Any = keys.get("points") if isinstance(keys, dict) else None
    try:
        pairs = tuple((float(x), float(z)) for x, z in points)
    except (TypeError, ValueError) as error:
        raise InputError(f"{path}: points: expected a list of [x, z] in metres") from error
    if len(pairs) < 2 or any(b[0] <= a[0] for a, b in pairwise(pairs)):
        raise InputError(f"{path}: points: expected at least two points with rising x")
    return Profile(pairs)


def save_profile(profile: Profile, path: Path) -> None:
    """Write what ``load_profile`` reads."""
    path.write_text(yaml_text({"points": [list(p) for p in profile.points]}), encoding="utf-8")
