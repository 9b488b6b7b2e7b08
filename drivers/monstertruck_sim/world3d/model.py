"""The MuJoCo model: MJCF for a robot, its drive line, and the ground and walls around it.

Geometries are grouped into ground, walls, blocks on the ground, the robot, and bodies that move or can be added.
"""

import logging
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import IntEnum
from typing import ClassVar, Final, NamedTuple
from xml.etree import ElementTree as ET
from xml.etree.ElementTree import Element, SubElement

import mujoco
import numpy as np
from numpy.typing import NDArray

from monstertruck_kinematics.description import HEAD_JOINTS, Description, Part, PartJoint, Shape
from monstertruck_kinematics.elementary import Array
from monstertruck_runtime.errors import InputError
from monstertruck_sim.world.camera import CELLS, PAPER_CELLS, tag_axes, tag_pattern
from monstertruck_sim.world.config import RoofTag, TagConfig
from monstertruck_sim.world3d.heights import HeightGrid

TIMESTEP: Final = 0.002
"""Time step (s)."""
SPARE: Final = 24
"""Number of spare discs, and of spare boxes, for a running world; people and other robots use them as well."""
PARKED: Final = -50.0
"""Height of unused spare bodies (m)."""
SUPPORTS: Final = tuple(f"support_{i}" for i in range(4))
"""Blocks that can be placed under wheels."""
TALL: Final = 0.6
"""Height of objects added to a world (m)."""

log = logging.getLogger(__name__)


class Warnings:
    """Collects MuJoCo's warnings, which it would otherwise write to a file in the current folder."""

    count: ClassVar[int] = 0

    @classmethod
    def take(cls, text: str) -> None:
        """Count and log a warning."""
        cls.count += 1
        log.warning("MuJoCo: %s", " ".join(text.split()))


class TouchBits(NamedTuple):
    """Contact bits: two geometries collide if the type of one shares a bit with the affinity of the other."""

    kind: int
    affinity: int

    @property
    def attributes(self) -> dict[str, str]:
        """MJCF attributes for a geometry."""
        return {"contype": f"{self.kind}", "conaffinity": f"{self.affinity}"}


UNTOUCHED: Final = TouchBits(0, 0)
CARRIES: Final = TouchBits(5, 2)
"""The ground."""
UPRIGHT: Final = TouchBits(9, 2)
"""Walls and obstacles."""
_TOUCHES: Final = {"all": TouchBits(2, 1), "ground": TouchBits(0, 4), "walls": TouchBits(0, 8)}
_TYRE: Final = "0.01 1"
"""Time constant (s) and damping ratio of the tyre contact, which yields 0.3 mm under the robot's weight."""


class Group(IntEnum):
    """Geometry groups."""

    GROUND = 0
    WALLS = 1
    BLOCKS = 2
    ROBOT = 3
    MOVING = 4
    SIGNS = 5
    """Tags, without contact."""


@dataclass(frozen=True, slots=True)
class DriveLine:
    """Mechanics between shafts and wheels.

    Args:
        shafts: spin joints of the wheels on every driven shaft. Open differentials connect them: the shaft turns at the
            mean speed of its wheels, and all wheels receive the same torque.
        locked: groups of spin joints that turn at the same mean speed (a rigid transfer case).
        stiffness: wind-up stiffness between a shaft and the mean of its wheels (Nm/rad).
        damping: wind-up damping (Nm s/rad).
        clutch: maximum total torque of a shaft's wheels (Nm).
        turns: turns of a spin joint per turn of its wheel, if not 1.
    """

    shafts: tuple[tuple[str, ...], ...]
    locked: tuple[tuple[tuple[str, ...], tuple[str, ...]], ...]
    stiffness: float
    damping: float
    clutch: float
    turns: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Block:
    """A box on the ground that wheels can climb: centre, sides (m) and yaw (rad)."""

    x: float
    y: float
    z: float
    length: float
    width: float
    height: float
    yaw: float = 0.0
    pitch: float = 0.0


@dataclass(frozen=True, slots=True)
class StaticScene:
    """Static part of the robot's surroundings.

    Args:
        walls: rectangles of solid map cells, (n, 4): minimum x, minimum y, maximum x, maximum y (m).
        wall_height: height of the walls above the ground (m).
        heights: ground heights; None if the ground is level at 0.
        blocks: blocks on the ground.
        scenery: assets, and bodies and geometries, from another MJCF file.
        tags: tags on the walls.
        roof: tag on the robot.
    """

    walls: Array
    wall_height: float
    heights: HeightGrid | None
    blocks: tuple[Block, ...] = ()
    scenery: tuple[Sequence[Element], Sequence[Element]] = ((), ())
    tags: tuple[TagConfig, ...] = ()
    roof: RoofTag | None = None


EMPTY: Final = StaticScene(np.zeros((0, 4)), TALL, None)
"""Level ground without walls or blocks."""


def rectangles(solid: NDArray[np.bool_], resolution: float, origin: tuple[float, float], longest: int = 80) -> Array:
    """Return a few rectangles that exactly cover the solid cells, (n, 4): x0, y0, x1, y1 (m).

    Args:
        solid: (rows, columns), row 0 lowest y.
        resolution: cell side (m).
        origin: position of the lower left corner (m).
        longest: maximum side of a rectangle (cells); short pieces of wall follow uneven ground.
    """
    left = solid.copy()
    found: list[tuple[int, int, int, int]] = []
    for row in range(solid.shape[0]):
        column = 0
        while (begin := _first(left[row], column)) is not None:
            end = begin + 1
            while end < solid.shape[1] and left[row, end] and end - begin < longest:
                end += 1
            top = row + 1
            while top < solid.shape[0] and top - row < longest and left[top, begin:end].all():
                top += 1
            left[row:top, begin:end] = False
            found.append((begin, row, end, top))
            column = end
    cells = np.array(found, dtype=np.float64).reshape(-1, 4)
    return np.asarray(cells * resolution + np.array([*origin, *origin]))


def _first(row: NDArray[np.bool_], start: int) -> int | None:
    where = np.flatnonzero(row[start:])
    return None if len(where) == 0 else start + int(where[0])


def mjcf(description: Description, drive: DriveLine, friction: float, scene: StaticScene) -> str:
    """Return the complete model as MJCF text.

    Args:
        description: robot description, whose first link moves freely.
        drive: the robot's drive line.
        friction: tyre friction coefficient.
        scene: static surroundings.
    """
    root = Element("mujoco", model=description.name)
    SubElement(root, "compiler", angle="radian", boundmass="0", boundinertia="0", autolimits="true")
    SubElement(
        root,
        "option",
        timestep=f"{TIMESTEP}",
        gravity="0 0 -9.81",
        integrator="implicitfast",
        cone="elliptic",
        impratio="10",
    )
    SubElement(root, "size", memory="16M")
    visual = SubElement(root, "visual")
    SubElement(visual, "global", offwidth="1280", offheight="960", fovy="60")
    SubElement(visual, "map", znear="0.005", zfar="100")
    # Only a nearby lamp would need boxes with subdivided sides, and software rendering draws each part three times.
    SubElement(visual, "quality", shadowsize="1024", offsamples="0", numquads="1")
    SubElement(visual, "headlight", ambient="0.35 0.35 0.35", diffuse="0.25 0.25 0.25", specular="0 0 0")
    default = SubElement(root, "default")
    SubElement(default, "geom", CARRIES.attributes, friction=f"{friction} 0.005 0.0001")
    asset = SubElement(root, "asset")
    _materials(asset)
    world = SubElement(root, "worldbody")
    SubElement(world, "light", pos="0 0 6", dir="0.2 0.1 -1", directional="true", diffuse="0.45 0.45 0.45")
    _ground(asset, world, scene.heights)
    _walls(world, scene)
    for i, block in enumerate(scene.blocks):
        SubElement(
            world,
            "geom",
            name=f"block_{i}",
            type="box",
            group=f"{Group.BLOCKS.value}",
            size=_text(block.length / 2, block.width / 2, block.height / 2),
            pos=_text(block.x, block.y, block.z),
            euler=_text(0.0, block.pitch, block.yaw),
            rgba="0.55 0.5 0.42 1",
        )
    _scenery(asset, world, scene.scenery)
    _tags(asset, world, scene.tags)
    _spare(world)
    body = _robot(world, description)
    if (roof := scene.roof) is not None:
        _paper(asset, body, "roof", roof.size, (roof.x, roof.y, roof.z), (0.0, -1.0, 0.0, 1.0, 0.0, 0.0))
    _drive(root, description, drive)
    return ET.tostring(root, encoding="unicode")


def load(description: Description, drive: DriveLine, friction: float, scene: StaticScene) -> mujoco.MjModel:
    """Compile ``mjcf`` and fill in the heights.

    Raises:
        InputError: the scenery from another file does not compile.
    """
    mujoco.set_mju_user_warning(Warnings.take)
    try:
        model = mujoco.MjModel.from_xml_string(mjcf(description, drive, friction, scene))
    except ValueError as error:
        raise InputError(f"sim.world: MuJoCo refuses the model: {' '.join(str(error).split())}") from error
    if (heights := scene.heights) is not None:
        low, rise = _relief(heights)
        model.hfield_data[:] = ((heights.z - low) / rise).astype(np.float32).ravel()
    named = {f"tag_{i}": tag.tag for i, tag in enumerate(scene.tags)}
    if scene.roof is not None:
        named["roof"] = scene.roof.tag
    for name, tag in named.items():
        texture = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_TEXTURE, name)
        pixels = model.tex_width[texture] // PAPER_CELLS
        shades = np.kron(tag_pattern(tag), np.ones((pixels, pixels), np.uint8))
        data = np.repeat(shades[:, :, None], model.tex_nchannel[texture], axis=2).ravel()
        model.tex_data[model.tex_adr[texture] : model.tex_adr[texture] + len(data)] = data
    return model


def _materials(asset: Element) -> None:
    SubElement(
        asset,
        "texture",
        name="checks",
        type="2d",
        builtin="checker",
        width="256",
        height="256",
        rgb1="0.62 0.66 0.6",
        rgb2="0.54 0.58 0.53",
    )
    SubElement(asset, "material", name="floor", texture="checks", texrepeat="1 1", texuniform="true", reflectance="0")
    SubElement(
        asset,
        "texture",
        name="sky",
        type="skybox",
        builtin="gradient",
        width="128",
        height="768",
        rgb1="0.75 0.82 0.9",
        rgb2="0.4 0.5 0.65",
    )


def _relief(heights: HeightGrid) -> tuple[float, float]:
    """Return the lowest height and the relief above it (m), which must not be 0 for a height field."""
    low, high = float(heights.z.min()), float(heights.z.max())
    return low, max(high - low, 1e-3)


def _ground(asset: Element, world: Element, heights: HeightGrid | None) -> None:
    ground = {"name": "ground", "group": f"{Group.GROUND.value}", "material": "floor"}
    if heights is None:
        SubElement(world, "geom", ground, type="plane", size="0 0 1")
        return
    rows, columns = heights.z.shape
    half_x, half_y = (columns - 1) * heights.resolution / 2, (rows - 1) * heights.resolution / 2
    low, rise = _relief(heights)
    size = _text(half_x, half_y, rise, 1.0)
    SubElement(asset, "hfield", name="heights", nrow=f"{rows}", ncol=f"{columns}", size=size)
    place = _text(heights.origin[0] + half_x, heights.origin[1] + half_y, low)
    SubElement(world, "geom", ground, type="hfield", hfield="heights", pos=place)


def _walls(world: Element, scene: StaticScene) -> None:
    for i, (x0, y0, x1, y1) in enumerate(scene.walls):
        low, high = (0.0, 0.0) if scene.heights is None else scene.heights.between(x0, y0, x1, y1)
        top, bottom = high + scene.wall_height, low - 0.2
        SubElement(
            world,
            "geom",
            UPRIGHT.attributes,
            name=f"wall_{i}",
            type="box",
            group=f"{Group.WALLS.value}",
            size=_text((x1 - x0) / 2, (y1 - y0) / 2, (top - bottom) / 2),
            pos=_text((x0 + x1) / 2, (y0 + y1) / 2, (top + bottom) / 2),
            rgba="0.86 0.84 0.78 1",
        )


def _tags(asset: Element, world: Element, tags: Sequence[TagConfig]) -> None:
    """Add sheets of paper to the walls, on which ``load`` paints the tags."""
    for i, tag in enumerate(tags):
        right, up = tag_axes(tag.yaw, lies=tag.lies)
        _paper(asset, world, f"tag_{i}", tag.size, (tag.x, tag.y, tag.z + 0.001 * tag.lies), (*right, *up))


def _paper(
    asset: Element, parent: Element, name: str, size: float, place: tuple[float, float, float], axes: Sequence[float]
) -> None:
    pixels = f"{PAPER_CELLS * 16}"
    SubElement(asset, "texture", name=name, type="2d", builtin="flat", width=pixels, height=pixels, nchannel="3")
    SubElement(
        asset, "material", name=name, texture=name, texrepeat="1 1", texuniform="false", specular="0", emission="0.3"
    )
    side = size * PAPER_CELLS / CELLS / 2
    SubElement(
        parent,
        "geom",
        name=name,
        type="box",
        group=f"{Group.SIGNS.value}",
        contype="0",
        conaffinity="0",
        mass="0",
        size=_text(side, side, 0.0005),
        pos=_text(*place),
        xyaxes=_text(*axes),
        material=name,
    )


def _scenery(asset: Element, world: Element, scenery: tuple[Sequence[Element], Sequence[Element]]) -> None:
    asset.extend(scenery[0])
    for element in scenery[1]:
        for geom in element.iter("geom"):
            geom.set("group", f"{Group.BLOCKS.value}")
            for key, value in CARRIES.attributes.items():
                geom.set(key, value)
        world.append(element)


def _spare(world: Element) -> None:
    for i in range(SPARE):
        for kind, size in (("disc", _text(0.1, TALL / 2)), ("box", _text(0.1, 0.1, TALL / 2))):
            body = SubElement(world, "body", name=f"{kind}_{i}", mocap="true", pos=_text(0.0, 0.0, PARKED))
            shape = "cylinder" if kind == "disc" else "box"
            group = f"{Group.MOVING.value}"
            look = {**UPRIGHT.attributes, "type": shape, "size": size, "group": group, "rgba": "0.8 0.45 0.15 0"}
            SubElement(body, "geom", look, name=f"{kind}_{i}")
    sides = 0.12, 0.12, 0.4  # m; the lower part is below the ground
    for name in SUPPORTS:
        body = SubElement(world, "body", name=name, mocap="true", pos=_text(0.0, 0.0, PARKED))
        size = _text(*(side / 2 for side in sides))
        look = {"group": f"{Group.GROUND.value}", "rgba": "0.55 0.5 0.42 1"}
        SubElement(body, "geom", look, **UNTOUCHED.attributes, name=name, type="box", size=size)


def _robot(world: Element, description: Description) -> Element:
    base = description.links[0]
    body = SubElement(world, "body", name=base.name)
    SubElement(body, "freejoint", name="free")
    _link(body, base)
    _children(body, description, base.name)
    return body


def _children(parent: Element, description: Description, name: str) -> None:
    for joint in description.children(name):
        body = SubElement(parent, "body", name=joint.child, pos=_text(*joint.origin), euler=_text(*joint.turn))
        if joint.kind != "fixed":
            _joint(body, joint)
        _link(body, description.link(joint.child))
        _children(body, description, joint.child)


def _joint(body: Element, joint: PartJoint) -> None:
    element = SubElement(
        body,
        "joint",
        name=joint.name,
        type="slide" if joint.kind == "prismatic" else "hinge",
        axis=_text(*joint.axis),
        damping=f"{joint.damping:.9g}",
        frictionloss=f"{joint.friction:.9g}",
    )
    if joint.limits is not None:
        element.set("range", _text(*joint.limits))
    if joint.stiffness:
        element.set("stiffness", f"{joint.stiffness:.9g}")
        element.set("springref", f"{joint.load / joint.stiffness:.9g}")
    if joint.name in HEAD_JOINTS:
        element.set("armature", "0.001")
    if joint.name.endswith("_steer"):
        # Armature of a steering servo behind its linkage, as it acts on each wheel (kg m^2).
        element.set("armature", "0.002")


def _link(body: Element, link: Part) -> None:
    if link.mass > 0.0:
        SubElement(body, "inertial", pos=_text(*link.centre), mass=f"{link.mass:.9g}", diaginertia=_text(*link.inertia))
    for i, shape in enumerate(link.shapes):
        _shape(body, shape, f"{link.name}_{i}")


def _shape(body: Element, shape: Shape, name: str) -> None:
    geom = SubElement(
        body,
        "geom",
        _TOUCHES[shape.touches].attributes,
        name=name,
        group=f"{Group.ROBOT.value}",
        pos=_text(*shape.centre),
        rgba=shape.colour if shape.seen else "0 0 0 0",
    )
    if shape.slick:
        geom.set("condim", "1")
        geom.set("priority", "1")
    if shape.kind == "ball":
        geom.set("type", "sphere")
        geom.set("solref", _TYRE)
        geom.set("priority", "1")
        geom.set("size", _text(*shape.size))
        return
    if shape.kind == "box":
        geom.set("type", "box")
        geom.set("size", _text(*(side / 2 for side in shape.size)))
        return
    radius, width = shape.size
    geom.set("type", "cylinder")
    geom.set("size", _text(radius, width / 2))
    geom.set("euler", _text(math.pi / 2, shape.yaw, 0.0))


HEAD_LAG: Final = 0.01
"""Lag of a joint behind its turning shaft (s), caused by its damper."""


def _drive(root: Element, description: Description, drive: DriveLine) -> None:
    tendons, equalities, actuators = (SubElement(root, name) for name in ("tendon", "equality", "actuator"))

    def mean(name: str, joints: Sequence[str]) -> None:
        fixed = SubElement(tendons, "fixed", name=name)
        for joint in joints:
            turns = drive.turns.get(joint, 1.0)
            SubElement(fixed, "joint", joint=joint, coef=f"{1 / (turns * len(joints)):.9g}")

    for i, pair in enumerate(drive.locked):
        for name, joints in zip((f"case_{i}_a", f"case_{i}_b"), pair, strict=True):
            mean(name, joints)
        SubElement(equalities, "tendon", tendon1=f"case_{i}_a", tendon2=f"case_{i}_b", solref="0.01 1")
    for joint in description.joints:
        if joint.name.endswith("_steer"):
            gains = {"kp": "60.0", "kv": "0.8"}  # Nm/rad and Nm s/rad: the linkage is slightly compliant
            SubElement(actuators, "position", gains, name=joint.name, joint=joint.name)
    for joint in description.joints:
        if joint.name in HEAD_JOINTS:
            stiffness = 15.0  # between a stabiliser's shaft and its load, Nm/rad
            gains = {"kp": f"{stiffness}", "kv": f"{HEAD_LAG * stiffness}"}
            SubElement(actuators, "position", gains, name=joint.name, joint=joint.name)
    for i, joints in enumerate(drive.shafts):
        mean(f"shaft_{i}", joints)
        SubElement(
            actuators,
            "general",
            name=f"shaft_{i}",
            tendon=f"shaft_{i}",
            gainprm=f"{drive.stiffness:.9g}",
            biastype="affine",
            biasprm=_text(0.0, -drive.stiffness, -drive.damping),
            forcerange=_text(-drive.clutch, drive.clutch),
        )


def _text(*values: float) -> str:
    return " ".join(f"{value:.9g}" for value in values)
