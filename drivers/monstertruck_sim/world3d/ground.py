"""A world's ground: a height grid, objects on the ground, and geometries from other MJCF files."""

from collections.abc import Sequence
from math import ceil, cos, radians, sin, tan
from pathlib import Path
from typing import Final
from xml.etree import ElementTree as ET

import numpy as np

from monstertruck_kinematics.elementary import Array
from monstertruck_kinematics.se2 import Pose2
from monstertruck_runtime.errors import InputError
from monstertruck_runtime.outside import contents, picture, reading
from monstertruck_runtime.small_files import MEGABYTE
from monstertruck_sim.world.config import (
    Ditch,
    GroundFeature,
    HeightImage,
    Hills,
    Rubble,
    Slope,
    UprightStep,
    WorldConfig,
)
from monstertruck_sim.world.noise import GROUND_STREAM, generator
from monstertruck_sim.world.terrain import LEVEL, Profile, Terrain
from monstertruck_sim.world3d.heights import HeightGrid
from monstertruck_sim.world3d.model import Block

HEIGHT_STEP: Final = 0.05
"""Spacing of the height field's points (m)."""

Bounds = tuple[float, float, float, float]
"""Minimum and maximum x, then y (m)."""


def ground_heights(
    config: WorldConfig, profile: Profile | None, bounds: Bounds, starts: Sequence[Pose2]
) -> HeightGrid | None:
    """Return the sum of the map's profile, rough patches, features and height image; None if the ground is level.

    Args:
        config: world configuration.
        profile: the map's profile.
        bounds: map bounds.
        starts: start poses of all robots in the world, which share the ground.

    Raises:
        InputError: the height image does not exist.
    """
    shaped = any(not isinstance(feature, UprightStep | Rubble) for feature in config.ground)
    if profile is None and not config.rough and not shaped and config.height_image is None:
        return None
    margin = 1.0  # margin of the height field beyond the map, m
    x0, x1, y0, y1 = bounds[0] - margin, bounds[1] + margin, bounds[2] - margin, bounds[3] + margin
    columns, rows = (ceil((high - low) / HEIGHT_STEP) + 1 for low, high in ((x0, x1), (y0, y1)))
    x, y = np.meshgrid(x0 + np.arange(columns) * HEIGHT_STEP, y0 + np.arange(rows) * HEIGHT_STEP)
    z = Terrain(profile or LEVEL, config.rough).height(x, y)
    for feature in config.ground:
        z = z + _height(feature, x, y, starts)
    if config.height_image is not None:
        z = z + _pictured(config.height_image).height(x, y)
    return HeightGrid(np.ascontiguousarray(z), HEIGHT_STEP, (x0, y0))


def _height(feature: GroundFeature, x: Array, y: Array, starts: Sequence[Pose2]) -> Array:
    if isinstance(feature, Hills):
        return _hills(feature, x, y, starts)
    if isinstance(feature, Slope):
        along = (x - feature.x) * cos(feature.direction) + (y - feature.y) * sin(feature.direction)
        return np.asarray(np.clip(along, 0.0, feature.length) * tan(radians(feature.angle_deg)))
    if isinstance(feature, Ditch):
        c, s = cos(feature.yaw), sin(feature.yaw)
        along, across = c * (x - feature.x) + s * (y - feature.y), c * (y - feature.y) - s * (x - feature.x)
        side = np.clip(
            2.0 * (1.0 - abs(across) / (feature.width / 2)), 0.0, 1.0
        )  # the bottom is the middle half of the width
        end = np.clip((feature.length / 2 - abs(along)) / (feature.width / 4), 0.0, 1.0)
        return np.asarray(-feature.depth * side * end)
    return np.zeros_like(x)


def _hills(feature: Hills, x: Array, y: Array, starts: Sequence[Pose2]) -> Array:
    """Return noise without wavelengths below ``wavelength``, level around the start poses."""
    noise = generator(feature.seed, GROUND_STREAM).standard_normal(x.shape)
    spectrum = np.fft.rfft2(noise)
    fy, fx = np.fft.fftfreq(x.shape[0], HEIGHT_STEP), np.fft.rfftfreq(x.shape[1], HEIGHT_STEP)
    short = np.hypot(fy[:, None], fx) * feature.wavelength
    z = np.fft.irfft2(spectrum * np.exp(-(short**4)), s=x.shape)
    z *= feature.height / max(float(z.std()), 1e-12)
    away = np.min([np.hypot(x - start[0], y - start[1]) for start in starts], axis=0)
    rise = np.clip((away - feature.flat) / feature.wavelength, 0.0, 1.0)
    return np.asarray(z * rise * rise * (3.0 - 2.0 * rise))


def _pictured(config: HeightImage) -> HeightGrid:
    with picture(config.file, "a height image (sim.world.height_image)") as image:
        grey = np.asarray(image.convert("I" if image.mode.startswith("I") else "L"), dtype=np.float64)
        white = 65535.0 if image.mode.startswith("I") else 255.0
    return HeightGrid(np.ascontiguousarray(grey[::-1]) / white * config.height, config.resolution, (config.x, config.y))


def blocks(features: Sequence[GroundFeature], heights: HeightGrid | None) -> tuple[Block, ...]:
    """Return steps and stones, each slightly embedded in the ground."""
    found: list[Block] = []
    for feature in features:
        if isinstance(feature, UprightStep):
            found.append(
                _standing(heights, feature.x, feature.y, (feature.length, feature.width, feature.height), feature.yaw)
            )
        elif isinstance(feature, Rubble):
            rng = generator(feature.seed, GROUND_STREAM, 1)
            for _ in range(feature.count):
                x = feature.x + float(rng.uniform(-0.5, 0.5)) * feature.length
                y = feature.y + float(rng.uniform(-0.5, 0.5)) * feature.width
                length, width = (feature.size * float(rng.uniform(0.3, 1.0)) for _ in range(2))
                size = length, width, feature.height * float(rng.uniform(0.3, 1.0))
                yaw, pitch = float(rng.uniform(-3.14, 3.14)), float(rng.uniform(-0.08, 0.08))
                found.append(_standing(heights, x, y, size, yaw, pitch))
    return tuple(found)


def _standing(
    heights: HeightGrid | None, x: float, y: float, size: tuple[float, float, float], yaw: float, pitch: float = 0.0
) -> Block:
    foot = 0.0 if heights is None else float(heights.height(np.array(x), np.array(y)))
    length, width, height = size
    embedded = 0.05  # depth of blocks in the ground, m
    middle = foot + (height - embedded) / 2
    return Block(x, y, middle, length, width, height + embedded, yaw, pitch)


def scenery(path: Path) -> tuple[list[ET.Element], list[ET.Element]]:
    """Read an MJCF file's assets, and its bodies and geometries; angles in radians, asset files with full paths.

    Angles in the file are in degrees and asset paths are relative to the file, unless its ``compiler`` element
    specifies otherwise (MuJoCo XML reference, element compiler).

    Raises:
        InputError: the file is not an MJCF file, contains a moving body, or uses unsupported features: default classes
            or another sequence of Euler angles.
    """
    expected = "MJCF (sim.world.mjcf)"
    text = contents(path, expected, 10 * MEGABYTE)  # bytes of an MJCF file
    with reading(path, expected):
        if b"<!ENTITY" in text:
            raise InputError(f"sim.world.mjcf: {path}: <!ENTITY: expected XML without entities")
        root = ET.fromstring(text)  # noqa: S314  # a file that the user names himself, without entities
    if root.tag != "mujoco":
        raise InputError(f"sim.world.mjcf: {path}: expected <mujoco>, found <{root.tag}>")
    for tag in ("joint", "freejoint", "flexcomp", "composite", "actuator", "include"):
        if next(root.iter(tag), None) is not None:
            raise InputError(f"sim.world.mjcf: {path}: <{tag}>: expected static geometries only, in one file")
    if next(root.iter("default"), None) is not None:
        raise InputError(f"sim.world.mjcf: {path}: <default>: expected geometries with all attributes written out")
    compiler = {name: value for element in root.findall("compiler") for name, value in element.items()}
    if (sequence := compiler.get("eulerseq", "xyz")) != "xyz":
        raise InputError(f"sim.world.mjcf: {path}: compiler eulerseq {sequence}: expected xyz")
    assets = [asset for section in root.findall("asset") for asset in section]
    for asset in assets:
        folder = compiler.get("texturedir" if asset.tag == "texture" else "meshdir", compiler.get("assetdir", ""))
        for name, file in asset.items():
            if name.startswith("file"):
                asset.set(name, str((path.parent / folder / file).resolve()))
    placed = [element for section in root.findall("worldbody") for element in section if element.tag != "light"]
    if compiler.get("angle", "degree") == "degree":
        _use_radians(path, placed)
    return assets, placed


def _use_radians(path: Path, elements: Sequence[ET.Element]) -> None:
    for element in (inner for outer in elements for inner in outer.iter()):
        for name, first in (("euler", 0), ("axisangle", 3)):
            if (text := element.get(name)) is not None:
                try:
                    values = [float(word) for word in text.split()]
                except ValueError:
                    raise InputError(f"sim.world.mjcf: {path}: {name} {text!r}: expected numbers") from None
                turned = values[:first] + [radians(angle) for angle in values[first:]]
                element.set(name, " ".join(map(repr, turned)))
