"""What every log says of the robot and the run."""

import dataclasses
from typing import Any

from monstertruck_drivers.epos.config import EposConfig
from monstertruck_drivers.maestro.config import MaestroConfig
from monstertruck_kinematics.chassis import Chassis
from monstertruckd.assembly.estimation import Body
from monstertruckd.config.load import Tree, resolved
from monstertruckd.config.truck import TruckConfig
from monstertruckd.host.versions import running_versions


def description(config: TruckConfig, body: Body, tree: Tree | None) -> dict[str, Any]:
    """Attachments of a log: configuration, calibration, origins of the values, versions."""
    origins = tree.origins if tree is not None else {}
    return {
        "config": resolved(config),
        "calibration": _calibration(config, body.chassis, tree),
        "origins": {".".join(map(str, key)): str(origin) for key, origin in origins.items()},
        "versions": dict(running_versions()),
    }


def _calibration(config: TruckConfig, chassis: Chassis, tree: Tree | None = None) -> dict[str, Any]:
    """Everything that was measured on this very truck, and the file it comes from, for the log."""
    devices = config.devices
    values: dict[str, Any] = {
        "file": None if tree is None or tree.calibration is None else str(tree.calibration),
        "wheel_radius_m": config.geometry.wheel_radius,
        "drive_ratio": config.geometry.drive_ratio,
        "linkage": None if chassis.linkage is None else dataclasses.asdict(chassis.linkage),
        "mounts": {role: device.mount.model_dump() for role, device in devices.present().items()},
    }
    values |= {
        f"{role}_inverted": device.driver.inverted
        for role, device in devices.shafts().items()
        if isinstance(device.driver, EposConfig)
    }
    if devices.steering is not None and isinstance(steering := devices.steering.driver, MaestroConfig):
        values |= {"front_servo": steering.front.model_dump(), "rear_servo": steering.rear.model_dump()}
        if steering.battery is not None:
            values["battery"] = steering.battery.model_dump()
    return values
