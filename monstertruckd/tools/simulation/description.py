"""The description of the robot that a configuration means."""

from monstertruck_kinematics.description import Description, Mechanics, SensorFrame
from monstertruck_runtime.errors import InputError
from monstertruck_sim.world.config import SOLID_BODIES, SimTruckConfig, WorldConfig
from monstertruck_sim.world.mechanics import description, mechanics
from monstertruckd.assembly.estimation import sensor_mounts
from monstertruckd.config.truck import TruckConfig
from monstertruckd.tools.simulation.config import SimulatedTruckConfig


def described(config: TruckConfig) -> Description:
    """The robot with the frames of its sensors.

    Raises:
        InputError: its body has no description.
    """
    truck, parts = _parts(config)
    sensors = tuple(
        SensorFrame(name, (m.x, m.y, m.z), (m.roll, m.pitch, m.yaw)) for name, m in sensor_mounts(config).items()
    )
    return description(truck, parts, sensors)


def model_text(config: TruckConfig) -> str:
    """The robot on level ground as MJCF."""
    from monstertruck_sim.world3d.engine import drive_line  # noqa: PLC0415  # the library of an extra
    from monstertruck_sim.world3d.model import EMPTY, mjcf  # noqa: PLC0415  # the library of an extra

    truck, parts = _parts(config)
    return mjcf(described(config), drive_line(truck, parts), parts.friction, EMPTY) + "\n"


def _parts(config: TruckConfig) -> tuple[SimTruckConfig, Mechanics]:
    """Body and dimensions as the daemon has them; masses and springs as simulated."""
    if config.body.kind not in SOLID_BODIES:
        raise InputError(f"body {config.body.kind}: has no description; expected one of {', '.join(SOLID_BODIES)}")
    world = config.sim.world if isinstance(config, SimulatedTruckConfig) else WorldConfig()
    geometry = config.geometry
    mass = world.truck.mass if isinstance(config, SimulatedTruckConfig) else geometry.mass
    truck = world.truck.model_copy(
        update={
            "body": config.body,
            "wheelbase": geometry.wheelbase,
            "track": geometry.track,
            "wheel_radius": geometry.wheel_radius,
            "length": geometry.length,
            "width": geometry.width,
            "mass": mass,
        }
    )
    return truck, mechanics(truck, world.mechanics)
