"""The row of the bumper, and its settings."""

from typing import Literal

from monstertruck_runtime.plugins import Plugin
from monstertruckd.gate.catalog import CheckConfig


class BumperConfig(CheckConfig):
    """Settings of the bumper."""

    kind: Literal["bumper"]
    shock: float = 8.0
    """Acceleration along x that counts as a contact (m/s^2)."""


BUMPER = Plugin(
    name="bumper",
    settings="truck_bumper.plugin:BumperConfig",
    implementation="truck_bumper.check:Bumper",
    doc="Stops the robot after a shock that the IMU feels",
)
