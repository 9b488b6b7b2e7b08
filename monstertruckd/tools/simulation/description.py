"""The description of the robot that a configuration means."""

from monstertruck_kinematics.description import Description, Mechanics, SensorFrame, Size, truck_description
from monstertruck_runtime.errors import InputError
from monstertruck_sim.world.config import SimTruckConfig, WorldConfig
from monstertruck_sim.world.mechanics import mechanics
from monstertruckd.assembly.estimation import sensor_mounts
from monstertruckd.config.truck import TruckConfig
from monstertruckd.tools.simulation.config import SimulatedTruckConfig


def described(config: TruckConfig) -> Description:
    """The robot with the frames of its sensors.

    Raises:
        InputError: its body has no description.
    """
    size, parts = _parts(config)
    sensors = tuple(
        SensorFrame(name, (m.x, m.y, m.z), (m.roll, m.pitch, m.yaw)) for name, m in sensor_mounts(config).items()
    )
    return truck_description(size, parts, sensors)


def model_text(config: TruckConfig) -> str:
    """The robot on level ground as MJCF."""
    from monstertruck_sim.world3d.engine import drive_line  # noqa: PLC0415  # the library of an extra
    from monstertruck_sim.world3d.model import EMPTY, mjcf  # noqa: PLC0415  # the library of an extra

    truck = config.sim.world.truck if isinstance(config, SimulatedTruckConfig) else SimTruckConfig()
    parts = _parts(config)[1]
    return mjcf(described(config), drive_line(truck, parts), parts.friction, EMPTY) + "\n"


def _parts(config: TruckConfig) -> tuple[Size, Mechanics]:
    if config.body.kind != "truck":
        raise InputError(f"body {config.body.kind}: has no description; truck has one")
    geometry = config.geometry
    size = Size(geometry.wheelbase, geometry.track, geometry.wheel_radius)
    world = config.sim.world if isinstance(config, SimulatedTruckConfig) else WorldConfig()
    if not isinstance(config, SimulatedTruckConfig):
        return size, mechanics(SimTruckConfig(mass=geometry.mass), world.mechanics)
    return size, mechanics(world.truck, world.mechanics)
