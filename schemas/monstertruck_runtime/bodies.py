"""Robot bodies by ``kind``, for the daemon and the simulated world."""

from typing import Annotated, Any, Final

from monstertruck_runtime.errors import InputError
from monstertruck_runtime.plugins import Catalog, Plugin
from monstertruck_schemas.body import BodyConfig

BODIES: Final = Catalog(
    "monstertruck.bodies",
    Plugin(
        name="truck",
        settings="monstertruck_schemas.body:TruckBody",
        implementation="monstertruck_kinematics.chassis:truck_chassis",
        doc="Two steered axles, one motor for all wheels",
    ),
    Plugin(
        name="ackermann",
        settings="monstertruck_schemas.body:AckermannBody",
        implementation="monstertruck_kinematics.chassis:ackermann_chassis",
        doc="A car: steered front axle, driven rear axle",
    ),
    Plugin(
        name="bicycle",
        settings="monstertruck_schemas.body:BicycleBody",
        implementation="monstertruck_kinematics.chassis:bicycle_chassis",
        doc="One steered front wheel, one fixed rear wheel",
    ),
    Plugin(
        name="tricycle",
        settings="monstertruck_schemas.body:TricycleBody",
        implementation="monstertruck_kinematics.chassis:tricycle_chassis",
        doc="One steered front wheel, two fixed rear wheels",
    ),
    Plugin(
        name="independent",
        settings="monstertruck_schemas.body:IndependentBody",
        implementation="monstertruck_kinematics.chassis:independent_chassis",
        doc="Two steered axles, a motor in every wheel",
    ),
    Plugin(
        name="differential",
        settings="monstertruck_schemas.body:DifferentialBody",
        implementation="monstertruck_kinematics.chassis:differential_chassis",
        doc="Two driven wheels and casters",
    ),
    Plugin(
        name="skid_steer",
        settings="monstertruck_schemas.body:SkidSteerBody",
        implementation="monstertruck_kinematics.chassis:skid_steer_chassis",
        doc="Left and right wheels, turning by skidding",
    ),
    Plugin(
        name="synchro",
        settings="monstertruck_schemas.body:SynchroBody",
        implementation="monstertruck_kinematics.chassis:synchro_chassis",
        doc="Wheels that all roll and steer together",
    ),
    Plugin(
        name="omni",
        settings="monstertruck_schemas.body:OmniBody",
        implementation="monstertruck_kinematics.chassis:omni_chassis",
        doc="Swedish wheels on a circle",
    ),
    Plugin(
        name="mecanum",
        settings="monstertruck_schemas.body:MecanumBody",
        implementation="monstertruck_kinematics.chassis:mecanum_chassis",
        doc="Four mecanum wheels",
    ),
    base=BodyConfig,
)
"""Catalog of bodies: functions that create a ``Chassis`` from its ``Dimensions`` and the settings of its kind."""

AnyBody = Annotated[BodyConfig, BODIES.section()]
"""Section `body` of the configuration."""


def build_chassis(body: BodyConfig, dimensions: Any) -> Any:
    """Create the ``Chassis`` of a body.

    Args:
        body: configured body.
        dimensions: ``monstertruck_kinematics.chassis.Dimensions``.

    Raises:
        InputError: the body does not load.
        ValueError: impossible dimensions, such as a ``KinematicsError``.
    """
    try:
        return BODIES.build(body, dimensions, **body.model_dump(exclude={"kind"}))
    except InputError as error:
        if isinstance(error.__cause__, ValueError):  # of the values, not of the plug-in
            raise error.__cause__ from None
        raise
