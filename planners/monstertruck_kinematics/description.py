"""Robot description of rigid links and joints, the common source of its MJCF, URDF and static frames.

Frames: x forward, y left, z up. The base frame is the geometric centre on level ground, at rest under the robot's own
weight: there every joint is at zero. Lengths m, masses kg, angles rad, SI units. Of the truck's masses, 7.25 kg in all
and 0.281 kg a wheel are the sum and a part of the author's robot description; how the rest is divided is assumed.
"""

import math
from dataclasses import dataclass, field
from typing import Final, Literal
from xml.etree import ElementTree as ET

from monstertruck_kinematics.elementary import KinematicsError, require_positive

GRAVITY: Final = 9.81
"""Gravitational acceleration (m/s^2)."""

Triple = tuple[float, float, float]
JointKind = Literal["fixed", "revolute", "continuous", "prismatic"]
WHEELS: Final = ("front_left", "front_right", "rear_left", "rear_right")
ZERO: Final[Triple] = (0.0, 0.0, 0.0)


@dataclass(frozen=True, slots=True)
class Shape:
    """Visual and collision shape of a link.

    ``box``: lengths along x, y, z. ``wheel``: radius and width of a cylinder about y. ``ball``: radius.
    """

    kind: Literal["box", "wheel", "ball"]
    size: tuple[float, ...]
    centre: Triple = ZERO
    colour: str = "0.35 0.36 0.4 1"
    """Red, green, blue and opacity, 0..1."""
    yaw: float = 0.0
    """Rotation of a cylinder about z (rad)."""
    touches: Literal["all", "ground", "walls"] = "all"
    slick: bool = False
    """Whether the shape has no friction."""
    seen: bool = True
    """Whether the shape appears in pictures and in files for viewers."""


@dataclass(frozen=True, slots=True)
class Part:
    """Rigid part.

    Args:
        name: name of its frame.
        mass: mass (kg); 0 for a frame without a body.
        centre: centre of mass, in its frame.
        inertia: inertia about the centre of mass, along the frame's axes.
        shapes: outer shapes.
    """

    name: str
    mass: float = 0.0
    centre: Triple = ZERO
    inertia: Triple = ZERO
    shapes: tuple[Shape, ...] = ()


@dataclass(frozen=True, slots=True)
class PartJoint:
    """Joint between a link and its parent; at zero the child's frame has the parent's orientation turned by ``turn``.

    Args:
        name: name of the joint.
        kind: motion: ``prismatic`` slides along the axis, ``revolute`` turns about it between its limits.
        parent: parent link.
        child: child link.
        origin: origin of the child's frame in the parent's frame.
        turn: roll, pitch and yaw of the child's frame.
        axis: unit vector.
        limits: minimum and maximum position; None without limits.
        stiffness: spring stiffness (N/m or Nm/rad).
        damping: damping (N s/m or Nm s/rad).
        load: spring preload at zero, along the axis (N or Nm).
        friction: dry friction (N or Nm).
    """

    name: str
    kind: JointKind
    parent: str
    child: str
    origin: Triple = ZERO
    turn: Triple = ZERO
    axis: Triple = (0.0, 0.0, 1.0)
    limits: tuple[float, float] | None = None
    stiffness: float = 0.0
    damping: float = 0.0
    load: float = 0.0
    friction: float = 0.0


@dataclass(frozen=True, slots=True)
class Mechanics:
    """Masses, springs and friction of the truck.

    Args:
        mass: total mass (kg).
        wheel_mass: mass of one wheel (kg).
        axle_mass: mass of one axle without its wheels (kg).
        mass_height: height of the sprung mass's centre above the ground (m).
        wheel_width: width of a wheel (m).
        droop: travel of an axle below its rest position before its stop (m).
        bump: travel of an axle above its rest position (m).
        spring: stiffness of one axle's two springs together (N/m); None: they carry nothing at the end of the droop.
        damping: damping of one axle, as a fraction of the critical damping of the body on both axles.
        axle_roll: maximum roll of an axle against the chassis (rad).
        roll_spring: roll stiffness of one axle (Nm/rad): both its springs at a third of the track from the middle.
        friction: friction coefficient between tyre and ground.
        rolling_resistance: rolling resistance, as a fraction of the weight.
        steering_limit: maximum steering angle of a wheel (rad).
        tyre_stiffness: force of one rolling tyre per small slip angle (N/rad) and per small slip ratio (N) (isotropic
            brush); 0: rigid wheels.
        relaxation: relaxation length of a tyre's deflection (m).
    """

    mass: float = 7.25
    wheel_mass: float = 0.281
    axle_mass: float = 0.45
    mass_height: float = 0.12
    wheel_width: float = 0.08
    droop: float = 0.010
    bump: float = 0.030
    spring: float | None = None
    damping: float = 0.35
    axle_roll: float = math.radians(10.0)
    roll_spring: float | None = None
    friction: float = 0.5
    rolling_resistance: float = 0.05
    steering_limit: float = math.radians(45.0)
    tyre_stiffness: float = 0.0
    relaxation: float = 0.04

    def __post_init__(self) -> None:
        for name in ("mass", "wheel_mass", "axle_mass", "mass_height", "wheel_width", "friction", "bump", "droop"):
            require_positive(name, getattr(self, name))
        require_positive("relaxation", self.relaxation)
        if self.sprung <= 0.0:
            raise KinematicsError(
                f"mass is {self.mass}: expected more than the wheels and axles, {self.mass - self.sprung:g} kg"
            )

    @property
    def sprung(self) -> float:
        """Sprung mass (kg)."""
        return self.mass - 4.0 * self.wheel_mass - 2.0 * self.axle_mass

    @property
    def axle_load(self) -> float:
        """Force on the springs of one axle at rest (N)."""
        return self.sprung * GRAVITY / 2.0

    @property
    def tyre_spring(self) -> float:
        """Stiffness of one tyre that does not roll (N/m)."""
        return self.tyre_stiffness / self.relaxation

    @property
    def axle_spring(self) -> float:
        """Stiffness of one axle's springs (N/m)."""
        return self.axle_load / self.droop if self.spring is None else self.spring


@dataclass(frozen=True, slots=True)
class Size:
    """Outer dimensions.

    Args:
        wheelbase: wheelbase (m).
        track: track (m).
        wheel_radius: wheel radius (m).
        length: length of the footprint (m).
        width: width (m).
    """

    wheelbase: float = 0.32
    track: float = 0.26
    wheel_radius: float = 0.075
    length: float = 0.47
    width: float = 0.34


@dataclass(frozen=True, slots=True)
class LidarHead:
    """Stabilised lidar with its servos: a pitch joint on the base, a roll joint on it, the lidar on the roll joint.

    Args:
        place: position of the pivot of both joints in the base frame (m).
        lidar_mass: mass of the lidar (kg) (data sheet: 160 g).
        servo_mass: mass of one servo (kg) (data sheet: 55 g).
        offset: height of the lidar's centre of mass above the joints (m).
    """

    place: Triple = (0.14, 0.0, 0.25)
    lidar_mass: float = 0.16
    servo_mass: float = 0.055
    offset: float = 0.02

    @property
    def mass(self) -> float:
        """Total mass (kg)."""
        return self.lidar_mass + 2.0 * self.servo_mass


HEAD_JOINTS: Final = ("lidar_pitch", "lidar_roll")


@dataclass(frozen=True, slots=True)
class SensorFrame:
    """Sensor mount on the base: name, position and roll, pitch, yaw."""

    name: str
    origin: Triple
    turn: Triple = ZERO


@dataclass(frozen=True)
class Description:
    """A tree of links.

    Args:
        name: name of the robot.
        links: links; the first is the base.
        joints: one joint for every other link, parents before children.

    Raises:
        KinematicsError: duplicate name, or a joint with missing links.
    """

    name: str
    links: tuple[Part, ...]
    joints: tuple[PartJoint, ...] = ()
    _by_name: dict[str, Part] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        known = {link.name: link for link in self.links}
        if len(known) < len(self.links):
            raise KinematicsError(f"description {self.name}: two links have the same name")
        reached = {self.links[0].name}
        for joint in self.joints:
            if joint.parent not in reached or joint.child not in known or joint.child in reached:
                raise KinematicsError(
                    f"joint {joint.name}: expected a parent defined before it and a child without another parent"
                )
            reached.add(joint.child)
        if reached != set(known):
            raise KinematicsError(
                f"description {self.name}: no joint leads to {', '.join(sorted(set(known) - reached))}"
            )
        object.__setattr__(self, "_by_name", known)

    @property
    def mass(self) -> float:
        """Mass of all links (kg)."""
        return sum(link.mass for link in self.links)

    def link(self, name: str) -> Part:
        """Return a link by name."""
        return self._by_name[name]

    def children(self, parent: str) -> tuple[PartJoint, ...]:
        """Return the joints to the children of a link."""
        return tuple(joint for joint in self.joints if joint.parent == parent)

    def frame(self, name: str) -> Triple:
        """Return the position of a link's frame in the base frame, all joints at zero; for unrotated frames."""
        by_child = {joint.child: joint for joint in self.joints}
        x, y, z = ZERO
        while name in by_child:
            joint = by_child[name]
            x, y, z = x + joint.origin[0], y + joint.origin[1], z + joint.origin[2]
            name = joint.parent
        return x, y, z


def box_inertia(mass: float, size: Triple) -> Triple:
    """Return the principal moments of a solid box (kg m^2)."""
    x, y, z = (side * side for side in size)
    return mass * (y + z) / 12.0, mass * (x + z) / 12.0, mass * (x + y) / 12.0


def wheel_inertia(mass: float, radius: float, width: float) -> Triple:
    """Return the principal moments of a wheel about y: half solid disc, half thin ring (kg m^2)."""
    spin = 0.75 * mass * radius * radius
    across = 0.5 * spin + mass * width * width / 12.0
    return across, spin, across


def wheel_shapes(radius: float, width: float) -> tuple[Shape, Shape]:
    """Return a wheel's outline on the hub, which touches walls, and a round tread on the tyre, which touches ground."""
    return (
        Shape("wheel", (radius, width), ZERO, "0.12 0.12 0.13 1", touches="walls"),
        Shape("ball", (radius,), touches="ground", seen=False),
    )


def truck_description(
    size: Size | None = None,
    mechanics: Mechanics | None = None,
    sensors: tuple[SensorFrame, ...] = (),
    head: LidarHead | None = None,
) -> Description:
    """Return the truck: a chassis on two solid axles, each with a vertical slide and a roll joint, four steered wheels.

    Args:
        size: dimensions; None for the truck dimensions.
        mechanics: masses and springs; None for the truck values.
        sensors: frames on the chassis.
        head: lidar on its joints, part of the sprung mass; None for a fixed lidar.
    """
    size, parts = size or Size(), mechanics or Mechanics()
    radius = size.wheel_radius
    bodywork = (0.31, 0.17, 0.074), (0.21, 0.24, 0.084)
    plate = radius + 0.02
    shapes = (
        Shape("box", (size.wheelbase + 0.06, 0.12, 0.04), (0.0, 0.0, plate)),
        Shape("box", bodywork[0], (0.0, 0.0, plate + 0.057), "0.75 0.28 0.2 1"),
        Shape("box", bodywork[1], (0.0, 0.0, plate + 0.136), "0.2 0.35 0.6 1"),
    )
    carried, lift, lever = 0.0, 0.0, 0.0
    if head is not None:
        carried, lift, lever = head.mass, head.mass * head.place[2], head.mass * head.place[0] / size.wheelbase
    body = parts.sprung - carried
    chassis = Part(
        "base",
        body,
        (0.0, 0.0, (parts.sprung * parts.mass_height - lift) / body),
        box_inertia(body, (size.wheelbase, 0.2, 0.14)),
        shapes,
    )
    links, joints = [chassis], []
    spring = parts.axle_spring
    damping = parts.damping * 2.0 * math.sqrt(spring * parts.sprung / 2.0)
    arm = size.track / 3.0
    roll = parts.roll_spring if parts.roll_spring is not None else spring * arm * arm
    lean = parts.sprung * GRAVITY * (parts.mass_height - radius)
    if 2.0 * roll <= lean:
        raise KinematicsError(
            f"roll_spring is {roll:g} Nm/rad: expected more than {lean / 2:g}, or the body falls over"
        )
    for axle, x, share in (("front", size.wheelbase / 2.0, lever), ("rear", -size.wheelbase / 2.0, -lever)):
        tube = (0.03, size.track - parts.wheel_width - 0.02, 0.03)
        slide = Part(
            f"{axle}_slide", parts.axle_mass / 2.0, ZERO, box_inertia(parts.axle_mass / 2.0, (0.04, 0.04, 0.04))
        )
        links += [
            slide,
            Part(
                f"{axle}_axle",
                parts.axle_mass / 2.0,
                ZERO,
                box_inertia(parts.axle_mass / 2.0, tube),
                (Shape("box", tube, ZERO, "0.5 0.5 0.5 1"),),
            ),
        ]
        joints += [
            PartJoint(
                f"{axle}_suspension",
                "prismatic",
                "base",
                slide.name,
                (x, 0.0, radius),
                limits=(-parts.droop, parts.bump),
                stiffness=spring,
                damping=damping,
                load=-(parts.axle_load + share * GRAVITY),
            ),
            PartJoint(
                f"{axle}_roll",
                "revolute",
                slide.name,
                f"{axle}_axle",
                axis=(1.0, 0.0, 0.0),
                limits=(-parts.axle_roll, parts.axle_roll),
                stiffness=roll,
                damping=damping * arm * arm,
            ),
        ]
        for side, y in (("left", size.track / 2.0), ("right", -size.track / 2.0)):
            wheel = f"{axle}_{side}"
            outline, ball = wheel_shapes(radius, parts.wheel_width)
            links += [
                Part(f"{wheel}_knuckle", HUB, ZERO, box_inertia(HUB, (0.03, 0.03, 0.03)), (outline,)),
                Part(
                    f"{wheel}_wheel",
                    turning_mass(parts),
                    ZERO,
                    wheel_inertia(turning_mass(parts), radius, parts.wheel_width),
                    (ball,),
                ),
            ]
            joints.append(
                PartJoint(
                    f"{wheel}_steer",
                    "revolute",
                    f"{axle}_axle",
                    f"{wheel}_knuckle",
                    (0.0, y, 0.0),
                    limits=(-parts.steering_limit, parts.steering_limit),
                )
            )
            rim = add_tyre(wheel, f"{wheel}_knuckle", parts, links, joints)
            joints += [
                PartJoint(
                    f"{wheel}_spin",
                    "continuous",
                    rim,
                    f"{wheel}_wheel",
                    axis=(0.0, 1.0, 0.0),
                    friction=parts.rolling_resistance * parts.mass * GRAVITY / 4.0 * radius,
                ),
            ]
    if head is not None:
        add_head(head, links, joints)
    add_sensors(sensors, links, joints)
    return Description("monstertruck", tuple(links), tuple(joints))


def add_tyre(wheel: str, hub: str, parts: Mechanics, links: list[Part], joints: list[PartJoint]) -> str:
    """Add a tyre's longitudinal and lateral compliance between hub and rim, if any; return the wheel's parent link.

    The simulator provides the springs: they act on the deflection of the contact patch, which rolling renews.
    """
    if parts.tyre_stiffness == 0.0:
        return hub
    # 0.2: share of the critical one of the robot on its tyres
    damping = 0.2 * 2.0 * math.sqrt(parts.tyre_spring * parts.mass / 4.0)
    for name, axis in (("along", (1.0, 0.0, 0.0)), ("across", (0.0, 1.0, 0.0))):
        rim = f"{wheel}_{name}"
        links.append(Part(rim, _RIM, ZERO, (1e-6, 1e-6, 1e-6)))
        joints.append(PartJoint(rim, "prismatic", hub, rim, axis=axis, damping=damping))
        hub = rim
    return hub


def turning_mass(parts: Mechanics) -> float:
    """Return the mass of a wheel without its hub and the link of the tyre compliance (kg)."""
    return parts.wheel_mass - HUB - (2.0 * _RIM if parts.tyre_stiffness else 0.0)


_RIM: Final = 1e-3
"""Mass of a link that only carries tyre compliance (kg)."""


def add_sensors(sensors: tuple[SensorFrame, ...], links: list[Part], joints: list[PartJoint]) -> None:
    """Add the sensor frames to the base."""
    for sensor in sensors:
        links.append(Part(sensor.name))
        joints.append(PartJoint(f"{sensor.name}_mount", "fixed", "base", sensor.name, sensor.origin, sensor.turn))


def add_head(head: LidarHead, links: list[Part], joints: list[PartJoint]) -> None:
    """Add the lidar and its joints to the base."""
    servo = (0.032, 0.05, 0.04)
    lidar = (0.05, 0.05, 0.07)
    links += [
        Part("lidar_pitch", 2.0 * head.servo_mass, ZERO, box_inertia(2.0 * head.servo_mass, servo)),
        Part(
            "lidar_head",
            head.lidar_mass,
            (0.0, 0.0, head.offset),
            box_inertia(head.lidar_mass, lidar),
            (Shape("box", lidar, (0.0, 0.0, head.offset - 0.02), "0.1 0.1 0.1 1"),),
        ),
    ]
    limits = (-math.radians(60.0), math.radians(60.0))
    joints += [
        PartJoint("lidar_pitch", "revolute", "base", "lidar_pitch", head.place, axis=(0.0, 1.0, 0.0), limits=limits),
        PartJoint("lidar_roll", "revolute", "lidar_pitch", "lidar_head", axis=(1.0, 0.0, 0.0), limits=limits),
    ]


HUB: Final = 0.04
"""Mass of a knuckle or hub (kg); included in the wheel mass."""


def urdf(description: Description) -> str:
    """Return the description in Unified Robot Description Format, for viewers; the format has no springs."""
    robot = ET.Element("robot", name=description.name)
    for link in description.links:
        element = ET.SubElement(robot, "link", name=link.name)
        if link.mass > 0.0:
            inertial = ET.SubElement(element, "inertial")
            ET.SubElement(inertial, "origin", xyz=_numbers(link.centre), rpy="0 0 0")
            ET.SubElement(inertial, "mass", value=f"{link.mass:.6g}")
            ixx, iyy, izz = (f"{value:.6g}" for value in link.inertia)
            ET.SubElement(inertial, "inertia", ixx=ixx, iyy=iyy, izz=izz, ixy="0", ixz="0", iyz="0")
        for kind in ("visual", "collision"):
            for shape in (shape for shape in link.shapes if shape.seen):
                _urdf_shape(ET.SubElement(element, kind), shape, coloured=kind == "visual")
    for joint in description.joints:
        element = ET.SubElement(robot, "joint", name=joint.name, type=joint.kind)
        ET.SubElement(element, "parent", link=joint.parent)
        ET.SubElement(element, "child", link=joint.child)
        ET.SubElement(element, "origin", xyz=_numbers(joint.origin), rpy=_numbers(joint.turn))
        if joint.kind == "fixed":
            continue
        ET.SubElement(element, "axis", xyz=_numbers(joint.axis))
        if joint.limits is not None:
            lower, upper = joint.limits
            bounds = {"lower": f"{lower:.6g}", "upper": f"{upper:.6g}", "effort": "100", "velocity": "10"}
            ET.SubElement(element, "limit", bounds)
        ET.SubElement(element, "dynamics", damping=f"{joint.damping:.6g}", friction=f"{joint.friction:.6g}")
    ET.indent(robot)
    return '<?xml version="1.0"?>\n' + ET.tostring(robot, encoding="unicode") + "\n"


def _urdf_shape(element: ET.Element, shape: Shape, *, coloured: bool) -> None:
    turn = (math.pi / 2.0, 0.0, shape.yaw) if shape.kind == "wheel" else ZERO
    ET.SubElement(element, "origin", xyz=_numbers(shape.centre), rpy=_numbers(turn))
    geometry = ET.SubElement(element, "geometry")
    if shape.kind == "box":
        ET.SubElement(geometry, "box", size=_numbers(shape.size))
    elif shape.kind == "ball":
        ET.SubElement(geometry, "sphere", radius=f"{shape.size[0]:.6g}")
    else:
        radius, width = shape.size
        ET.SubElement(geometry, "cylinder", radius=f"{radius:.6g}", length=f"{width:.6g}")
    if coloured:
        material = ET.SubElement(element, "material", name=f"colour_{shape.colour.replace(' ', '_')}")
        ET.SubElement(material, "color", rgba=shape.colour)


def _numbers(values: tuple[float, ...]) -> str:
    return " ".join(f"{value:.6g}" for value in values)
