"""Descriptions of robots whose wheels are not steered: a platform on driven wheels, each on its own spring.

A wheel with rollers (Swedish, mecanum) is modelled by an ideal: a ball that rolls freely about the axis of its rollers
and is driven about the level axis across it. Along the rollers' axis it has the tyre's friction, across it rolls. The
ball touches the ground only; a wheel's outline around it touches walls.
"""

import math
from dataclasses import dataclass, replace
from typing import Final

from monstertruck_kinematics.description import (
    GRAVITY,
    HUB,
    ZERO,
    Description,
    LidarHead,
    Mechanics,
    Part,
    PartJoint,
    SensorFrame,
    Shape,
    Size,
    add_head,
    add_sensors,
    add_tyre,
    box_inertia,
    turning_mass,
    wheel_inertia,
    wheel_shapes,
)
from monstertruck_kinematics.elementary import KinematicsError
from monstertruck_kinematics.wheels import SwedishWheel, Wheel

_CASTER: Final = 0.05
"""Mass of a caster, kg."""


@dataclass(frozen=True, slots=True)
class BallCaster:
    """A ball that carries its share of the weight, and slides without friction: name, place and radius, m."""

    name: str
    x: float
    y: float
    radius: float


def frame_name(wheel: Wheel) -> str:
    """Names of a wheel's links and joints."""
    return wheel.name.replace(" ", "_")


def rolled(wheel: Wheel) -> float:
    """Turns of a wheel's joint ``NAME_spin`` a turn of the wheel: a mecanum wheel is driven across its rollers only."""
    return math.cos(wheel.roller) if isinstance(wheel, SwedishWheel) else 1.0


def platform_description(
    size: Size,
    parts: Mechanics,
    wheels: tuple[Wheel, ...],
    casters: tuple[BallCaster, ...] = (),
    sensors: tuple[SensorFrame, ...] = (),
    head: LidarHead | None = None,
) -> Description:
    """A platform on driven wheels and casters, its centre of mass over the geometric centre.

    Args:
        size: its dimensions.
        parts: masses and springs; an axle's mass belongs to the platform.
        wheels: driven ones; each wheel carries as much as any other.
        casters: further supports.
        sensors: frames on the platform.
        head: the lidar on its joints; None if it is fixed.

    Raises:
        KinematicsError: springs that do not hold it upright, or more wheels than mass.
    """
    sprung = parts.mass - len(wheels) * parts.wheel_mass - len(casters) * _CASTER
    carried, lift, lever = (0.0, 0.0, 0.0) if head is None else (head.mass, *_moments(head))
    body = sprung - carried
    if body <= 0.0:
        raise KinematicsError(
            f"mass is {parts.mass}: expected more than wheels and lidar together, {parts.mass - body:g} kg"
        )
    centre = -lever / body, 0.0, (sprung * parts.mass_height - lift) / body
    deck = Shape("box", (size.length, size.width, 0.06), (0.0, 0.0, size.wheel_radius + 0.035), "0.75 0.28 0.2 1")
    links = [Part("base", body, centre, box_inertia(body, (size.length, size.width, 0.1)), (deck,))]
    joints: list[PartJoint] = []
    weight = sprung * GRAVITY
    caster_share = 0.1  # share of the weight on every caster
    share = (1.0 - caster_share * len(casters)) / len(wheels)
    roll = pitch = 0.0
    for name, x, y, radius, load in (
        *((frame_name(w), w.x, w.y, w.radius, share * weight) for w in wheels),
        *((c.name, c.x, c.y, c.radius, caster_share * weight) for c in casters),
    ):
        spring = load / parts.droop if parts.spring is None else parts.spring
        roll, pitch = roll + spring * y * y, pitch + spring * x * x
        joints.append(
            PartJoint(
                f"{name}_suspension",
                "prismatic",
                "base",
                f"{name}_hub",
                (x, y, radius),
                limits=(-parts.droop, parts.bump),
                stiffness=spring,
                damping=parts.damping * 2.0 * math.sqrt(spring * load / GRAVITY),
                load=-load,
            )
        )
    if min(roll, pitch) <= weight * parts.mass_height:
        raise KinematicsError(
            f"springs hold {min(roll, pitch):g} Nm/rad: expected more than {weight * parts.mass_height:g}, "
            "or the body falls over"
        )
    for joint, wheel in zip(joints[: len(wheels)], wheels, strict=True):
        _add_wheel(wheel, joint, parts, links, joints)
    for caster in casters:
        ball = Shape("ball", (caster.radius,), ZERO, "0.5 0.5 0.5 1", slick=True)
        inertia = box_inertia(_CASTER, (caster.radius, caster.radius, caster.radius))
        links.append(Part(f"{caster.name}_hub", _CASTER, ZERO, inertia, (ball,)))
    if head is not None:
        add_head(head, links, joints)
    add_sensors(sensors, links, joints)
    return Description("monstertruck", tuple(links), tuple(joints))


def _moments(head: LidarHead) -> tuple[float, float]:
    """Mass times height and times distance ahead, kg m."""
    return head.mass * head.place[2], head.mass * head.place[0]


def _add_wheel(wheel: Wheel, leg: PartJoint, parts: Mechanics, links: list[Part], joints: list[PartJoint]) -> None:
    name, radius, width = frame_name(wheel), wheel.radius, parts.wheel_width
    mass = parts.wheel_mass - HUB if isinstance(wheel, SwedishWheel) else turning_mass(parts)
    across, spin, _ = wheel_inertia(mass, radius, width)
    resistance = parts.rolling_resistance * -leg.load * radius
    outline, ball = wheel_shapes(radius, width)
    hub = f"{name}_hub"
    turn = wheel.heading + (wheel.roller if isinstance(wheel, SwedishWheel) else 0.0)
    around = replace(outline, yaw=wheel.heading - turn)
    links.append(Part(hub, HUB, ZERO, box_inertia(HUB, (0.03, 0.03, 0.03)), (around,)))
    if isinstance(wheel, SwedishWheel):
        # The hub's x axis is the rollers' own: along it the wheel drives.
        across, tread = spin / 2.0, f"{name}_rollers"
        links.append(Part(tread, 1e-3, ZERO, (1e-7, 1e-7, 1e-7)))
        joints.append(PartJoint(tread, "continuous", hub, tread, axis=(1.0, 0.0, 0.0), friction=resistance))
    else:
        tread = add_tyre(name, hub, parts, links, joints)
    joints[joints.index(leg)] = replace(leg, turn=(0.0, 0.0, turn))
    links.append(Part(f"{name}_wheel", mass, ZERO, (across, spin, across), (ball,)))
    joints.append(
        PartJoint(f"{name}_spin", "continuous", tread, f"{name}_wheel", axis=(0.0, 1.0, 0.0), friction=resistance)
    )
