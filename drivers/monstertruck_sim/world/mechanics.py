"""Convert the configured body, masses and springs to the robot description."""

from math import radians

from monstertruck_kinematics.description import (
    Description,
    LidarHead,
    Mechanics,
    SensorFrame,
    Size,
    truck_description,
)
from monstertruck_kinematics.elementary import KinematicsError
from monstertruck_kinematics.platform import BallCaster, platform_description
from monstertruck_kinematics.unsteered import mecanum, omni
from monstertruck_kinematics.wheels import FixedWheel, Wheel
from monstertruck_runtime.errors import InputError
from monstertruck_schemas.body import OmniBody
from monstertruck_sim.world.config import MechanicsConfig, SimTruckConfig


def mechanics(truck: SimTruckConfig, config: MechanicsConfig) -> Mechanics:
    """Return the inputs for the description.

    Raises:
        InputError: the masses are impossible.
    """
    try:
        return Mechanics(
            mass=truck.mass,
            wheel_mass=config.wheel_mass,
            axle_mass=config.axle_mass,
            mass_height=config.mass_height,
            wheel_width=config.wheel_width,
            droop=config.droop,
            bump=config.bump,
            damping=config.damping,
            axle_roll=radians(config.axle_roll_deg),
            friction=config.friction,
            rolling_resistance=truck.rolling_resistance,
            tyre_stiffness=config.tyre_stiffness,
            relaxation=config.relaxation,
        )
    except KinematicsError as error:
        raise InputError(f"sim.world.mechanics: {error}") from error


def platform_wheels(truck: SimTruckConfig) -> tuple[Wheel, ...]:
    """Return the driven wheels of a platform, in the order of its shafts; empty for other bodies."""
    body, radius = truck.body, truck.wheel_radius
    if isinstance(body, OmniBody):
        return omni(body.circle, radius, body.count).swedish
    if body.kind == "mecanum":
        return mecanum(truck.wheelbase, truck.track, radius).swedish
    if body.kind == "differential":
        half = truck.track / 2.0
        return FixedWheel("left", 0.0, half, radius), FixedWheel("right", 0.0, -half, radius)
    return ()


def description(
    truck: SimTruckConfig,
    parts: Mechanics,
    sensors: tuple[SensorFrame, ...] = (),
    head: LidarHead | None = None,
) -> Description:
    """Return the mechanics of a robot whose body is one of ``SOLID_BODIES``.

    Args:
        truck: body and dimensions.
        parts: masses and springs.
        sensors: frames on the chassis.
        head: the lidar on its joints; None for a fixed lidar.

    Raises:
        InputError: the masses or springs are impossible.
    """
    try:
        return _description(truck, parts, sensors, head)
    except KinematicsError as error:
        raise InputError(f"sim.world.mechanics: {error}") from error


def _description(
    truck: SimTruckConfig, parts: Mechanics, sensors: tuple[SensorFrame, ...], head: LidarHead | None
) -> Description:
    size = Size(truck.wheelbase, truck.track, truck.wheel_radius, truck.length, truck.width)
    wheels = platform_wheels(truck)
    if not wheels:
        return truck_description(size, parts, sensors, head)
    radius = truck.wheel_radius / 2.0
    ends = (("front_caster", truck.length / 2.0 - radius), ("rear_caster", radius - truck.length / 2.0))
    casters = tuple(BallCaster(name, x, 0.0, radius) for name, x in ends) if truck.body.kind == "differential" else ()
    return platform_description(size, parts, wheels, casters, sensors, head)
