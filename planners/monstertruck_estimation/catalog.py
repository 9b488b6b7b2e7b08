"""Odometry kinds by ``kind``."""

from typing import Annotated, Final

from monstertruck_estimation.odometry import OdometrySettings
from monstertruck_runtime.plugins import Catalog, Plugin

ODOMETRY: Final = Catalog(
    "monstertruck.odometry",
    Plugin(
        name="reckoning",
        settings="monstertruck_estimation.odometry:OdometryConfig",
        implementation="monstertruck_estimation.odometry:build_reckoning",
        doc="Wheels along the steered arc, with the heading corrected by the compass",
    ),
    Plugin(
        name="encoders",
        settings="monstertruck_estimation.rear_wheels:RearWheelConfig",
        implementation="monstertruck_estimation.rear_wheels:build_rear_wheels",
        doc="Encoders of a tricycle's rear wheels, checked against the driven wheel",
    ),
    Plugin(
        name="fusion",
        settings="monstertruck_estimation.fusion.config:FusionConfig",
        implementation="monstertruck_estimation.fusion.service:build_fusion",
        doc="Filter of wheels, compass and the motion between scans",
    ),
    base=OdometrySettings,
)
"""An odometry kind is a function that builds a ``Service`` from its settings and an ``OdometryContext``."""

AnyOdometry = Annotated[OdometrySettings, ODOMETRY.section("reckoning")]
"""Section `odometry` of the configuration."""
