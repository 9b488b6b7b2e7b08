"""Dimensions and mounts of a robot from its URDF (http://wiki.ros.org/urdf/XML), as sections of a configuration.

Frames as everywhere: x forward, y left, z up. URDF's base may be anywhere on the robot; ours is the middle of the
wheels on the ground, so mounts are shifted by that.
"""

import math
import re
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final
from xml.etree import ElementTree as ET

import numpy as np
from numpy.typing import NDArray

from monstertruck_runtime.errors import InputError
from monstertruck_runtime.outside import contents, quoted, reading, text_from, xml_from
from monstertruck_runtime.small_files import MEGABYTE

EXPECTED: Final = "URDF"
SENSORS: Final[Mapping[str, str]] = {
    "lidar": r"laser|lidar|scan|hokuyo|rplidar|urg",
    "camera": r"camera|cam_",
    "imu": r"imu",
}
"""Parts of the link names, by device."""
OPTICAL: Final = "optical"
"""Part of the name of a camera's frame whose z axis looks ahead: not a mount."""

Matrix = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class UrdfRobot:
    """Settings of a robot in a URDF."""

    name: str
    geometry: dict[str, float]
    """Settings of ``geometry``, m."""
    mounts: dict[str, dict[str, float]]
    """Mounts by device: ``x``, ``y``, ``z`` (m), ``yaw``, ``pitch``, ``roll`` (rad), without those that are 0."""
    remarks: tuple[str, ...] = ()
    """Warnings about the file."""

    def sections(self) -> dict[str, Any]:
        """Return the sections of a configuration."""
        return {"geometry": self.geometry, "devices": {role: {"mount": mount} for role, mount in self.mounts.items()}}


def load_urdf(file: Path, links: Mapping[str, str] | None = None) -> UrdfRobot:
    """Read a robot.

    Args:
        file: URDF; a xacro file has to be expanded first.
        links: link of a device, where its name does not show it.

    Raises:
        InputError: not URDF, no four wheels, or no such link; names the expectation.
    """
    with reading(file, EXPECTED):
        data = contents(file, EXPECTED, 10 * MEGABYTE)
        declared = re.match(rb"<\?xml[^>]*encoding=[\"'](?!utf-?8)([\w-]+)", data, re.IGNORECASE)
        text = data.decode(declared[1].decode()) if declared else text_from(data, file, EXPECTED)
        root = xml_from(text, file, EXPECTED)
        if root.tag != "robot":
            raise InputError(f"{file}: expected an element robot, found {root.tag}")
        if re.search(r"<xacro:|\$\{", text):
            raise InputError(f"{file}: is xacro: expected its output (`xacro {file.name} > robot.urdf`)")
        frames = _frames(root, file)
        wheels = _wheels(root, frames, file)
    geometry, centre = _geometry(root, frames, wheels, file)
    chosen = _sensors(frames, dict(links or {}), file)
    meshes = [link for link in frames if any(shape.tag == "mesh" for shape, _ in _shapes(root, link, file))]
    remark = f"{file}: size of {', '.join(meshes)[:200]} unknown (mesh): check geometry.length and geometry.width"
    mounts = {role: _mount(frames[link], centre) for role, link in chosen.items()}
    return UrdfRobot(root.get("name", ""), geometry, mounts, (remark,) if meshes else ())


def _frames(root: ET.Element, file: Path) -> dict[str, Matrix]:
    """Each link's frame in the root link's, shape (4, 4), with all joints at zero."""
    parents: dict[str, tuple[str, Matrix]] = {}
    for joint in root.findall("joint"):
        parent, child = (_named(joint, kind, file) for kind in ("parent", "child"))
        if child in parents:
            raise InputError(f"{file}: link {child} has two parents")
        parents[child] = (parent, _origin(joint, f"{file}: joint {joint.get('name')}"))
    found: dict[str, Matrix] = {}
    for name in (link.get("name", "") for link in root.findall("link")):
        matrix, at, passed = np.eye(4), name, {name}
        while at in parents:
            at, step = parents[at]
            matrix = step @ matrix
            if at in passed:
                raise InputError(f"{file}: link {at} is its own parent")
            passed.add(at)
        found[name] = matrix
    return found


def _named(joint: ET.Element, kind: str, file: Path) -> str:
    element = joint.find(kind)
    if element is None or not element.get("link"):
        raise InputError(f"{file}: joint {joint.get('name')}: expected a {kind} link")
    return element.get("link", "")


def _origin(element: ET.Element, where: str) -> Matrix:
    """The element's origin as a matrix, shape (4, 4)."""
    origin = element.find("origin")
    xyz, rpy = ((0.0, 0.0, 0.0) if origin is None else _numbers(origin, key, where, "0 0 0") for key in ("xyz", "rpy"))
    (x, y, z), (roll, pitch, yaw) = xyz, rpy
    (cr, sr), (cp, sp), (cy, sy) = ((math.cos(angle), math.sin(angle)) for angle in (roll, pitch, yaw))
    return np.array(
        (
            (cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr, x),
            (sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr, y),
            (-sp, cp * sr, cp * cr, z),
            (0.0, 0.0, 0.0, 1.0),
        )
    )


def _numbers(element: ET.Element, key: str, where: str, default: str = "") -> tuple[float, ...]:
    """Three finite numbers of an attribute."""
    text = element.get(key, default)
    with suppress(ValueError):
        numbers = tuple(float(word) for word in text.split())
        if len(numbers) == len("xyz") and all(map(math.isfinite, numbers)):
            return numbers
    raise InputError(f"{where}: {key}: expected three numbers, found {quoted(repr(text))}")


def _size(shape: ET.Element, key: str, where: str) -> float:
    text = shape.get(key, "")
    with suppress(ValueError):
        if 0.0 < (size := float(text)) < math.inf:
            return size
    raise InputError(f"{where}: {key}: expected metres > 0, found {quoted(repr(text))}")


def _shapes(root: ET.Element, link: str, file: Path) -> Iterator[tuple[ET.Element, Matrix]]:
    """Shapes of a link, and their places in its frame: those for collisions, else those for viewers."""
    for kind in ("collision", "visual"):
        parts = [part for row in root.findall("link") if row.get("name") == link for part in row.findall(kind)]
        for part in parts:
            for shape in part.findall("geometry/*"):
                yield shape, _origin(part, f"{file}: link {link}")
        if parts:
            return


def _wheels(root: ET.Element, frames: Mapping[str, Matrix], file: Path) -> dict[str, tuple[Matrix, float, float]]:
    """Places, radii and widths of the wheels: links on a turning joint that are round about y of the robot."""
    found: dict[str, tuple[Matrix, float, float]] = {}
    others: dict[str, str] = {}
    for joint in root.findall("joint"):
        link = _named(joint, "child", file)
        if joint.get("type") not in ("continuous", "revolute"):
            continue
        for shape, place in _shapes(root, link, file):
            axis = (frames[link] @ place)[:3, 2]
            if shape.tag == "cylinder" and abs(axis[1]) > 0.9:  # cosine: within 26 degrees
                radius, width = (_size(shape, name, f"{file}: link {link}") for name in ("radius", "length"))
                found[link] = ((frames[link] @ place)[:3, 3], radius, width)
            else:
                others[link] = shape.tag
    if len(found) != 4:
        names = ", ".join(found) or "none"
        names += "".join(f"; {link} is a {shape}" for link, shape in others.items() if link not in found)[:200]
        raise InputError(f"{file}: expected four wheels (cylinders about y on turning joints), found {names}")
    return found


def _geometry(
    root: ET.Element, frames: Mapping[str, Matrix], wheels: Mapping[str, tuple[Matrix, float, float]], file: Path
) -> tuple[dict[str, float], Matrix]:
    """Settings of ``geometry``, and the middle of the wheels on the ground, (3,)."""
    places = np.array([place for place, *_ in wheels.values()])
    radius = float(np.mean([radius for _, radius, _ in wheels.values()]))
    front = places[:, 0] > places[:, 0].mean()
    left = places[:, 1] > places[:, 1].mean()
    if sorted(zip(front.tolist(), left.tolist(), strict=True)) != [
        (a, b) for a in (False, True) for b in (False, True)
    ]:
        raise InputError(f"{file}: expected a wheel at each corner, found {', '.join(wheels)}")
    x, y = places[:, 0], places[:, 1]
    sizes = {
        "wheelbase": float(x[front].mean() - x[~front].mean()),
        "track": float(y[left].mean() - y[~left].mean()),
        "wheel_radius": radius,
    }
    reach = np.array((radius, max(width for *_, width in wheels.values()) / 2))
    low, high = places[:, :2].min(0) - reach, places[:, :2].max(0) + reach
    for link, frame in frames.items():
        for shape, place in _shapes(root, link, file):
            if shape.tag == "box":
                half = np.abs((frame @ place)[:2, :3]) @ (np.array(_numbers(shape, "size", f"{file}: link {link}")) / 2)
                middle = (frame @ place)[:2, 3]
                low, high = np.minimum(low, middle - half), np.maximum(high, middle + half)
    centre = np.array((*(0.5 * (places.min(0) + places.max(0)))[:2], places[:, 2].mean() - radius))
    sizes["length"], sizes["width"] = (2 * np.maximum(high - centre[:2], centre[:2] - low)).tolist()
    return {name: round(value, 4) for name, value in sizes.items()}, centre


def _sensors(frames: Mapping[str, Matrix], links: dict[str, str], file: Path) -> dict[str, str]:
    """Link of each device: the given one, else the first whose name shows it."""
    for role, link in links.items():
        if link not in frames:
            raise InputError(f"{file}: no link {link} for {role}: expected one of {', '.join(frames)[:200]}")
    for role, words in SENSORS.items():
        named = [name for name in frames if re.search(words, name, re.IGNORECASE) and OPTICAL not in name]
        if role not in links and named:
            links[role] = named[0]
    return links


def _mount(frame: Matrix, centre: Matrix) -> dict[str, float]:
    turn, (x, y, z) = frame[:3, :3], frame[:3, 3] - centre
    yaw, pitch = math.atan2(turn[1, 0], turn[0, 0]), -math.asin(min(max(turn[2, 0], -1.0), 1.0))
    mount = {"x": x, "y": y, "z": z, "yaw": yaw, "pitch": pitch, "roll": math.atan2(turn[2, 1], turn[2, 2])}
    rounded = {name: round(float(value), 4) for name, value in mount.items()}
    # A half turn rounded up is beyond pi, where settings of angles end.
    turns = {name: min(max(rounded[name], -math.pi), math.pi) for name in ("yaw", "pitch", "roll")}
    return {name: value for name, value in (rounded | turns).items() if value}
