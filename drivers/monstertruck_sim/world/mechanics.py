"""From the configured masses and springs to those of the description."""

from math import radians

from monstertruck_kinematics.description import Mechanics
from monstertruck_sim.world.config import MechanicsConfig, SimTruckConfig


def mechanics(truck: SimTruckConfig, config: MechanicsConfig) -> Mechanics:
    """What the description is made from."""
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
    )
