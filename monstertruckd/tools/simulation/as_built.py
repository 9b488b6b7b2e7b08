"""The true robot of a simulated twin, derived from its configuration: body, mounts, servos, motor, pack."""

import math
from collections.abc import Mapping
from typing import Any, TypeVar

from monstertruck_drivers.maestro.config import BatteryInputConfig
from monstertruck_drivers.servos import ServoPulses
from monstertruck_drivers.shafts import motor_limits
from monstertruck_drivers.vesc.config import VescServoConfig
from monstertruck_schemas.base import Schema
from monstertruck_schemas.body import Mount
from monstertruck_sim.world.config import MotorConfig, ServoModelConfig, WorldConfig
from monstertruckd.config.device_safety import packs
from monstertruckd.config.truck import TruckConfig

S = TypeVar("S", bound=Schema)


def as_built(world: WorldConfig, config: TruckConfig) -> WorldConfig:
    """Return ``world`` with the robot of ``config`` wherever it sets nothing itself."""
    geometry, devices = config.geometry, config.devices
    lengths = ("wheelbase", "track", "wheel_radius", "length", "width", "mass")
    truck = {name: getattr(geometry, name) for name in lengths} | {"body": config.body} | _servos(config)
    found: dict[str, Any] = {"truck": truck | {"motor": _motor(config)}, "battery": _pack(config)}
    for name in ("lidar", "lidar_2", "camera"):
        device = devices.present().get(name)
        found[name] = {} if device is None else _place(device.mount)
    return _below(world, found)


def _below(settings: S, found: Mapping[str, Any], *, stated: bool = True) -> S:
    """Return the settings, with derived values for those not set; a section that is not set gets all of them."""
    data = dict(settings)
    for name, value in found.items():
        inner, given = data.get(name), stated and name in settings.model_fields_set
        if isinstance(value, Mapping) and isinstance(inner, Schema):
            data[name] = _below(inner, value, stated=given)
        elif not given:
            data[name] = value
    return type(settings).model_validate(data)


def _place(mount: Mount) -> dict[str, float]:
    angles = {"yaw": mount.yaw, "pitch": mount.pitch, "roll": mount.roll}
    return {"x": mount.x, "y": mount.y, **angles} | ({"height": mount.z} if mount.z > 0 else {})


def _servos(config: TruckConfig) -> dict[str, Any]:
    """Return the servos of the axles by the controller's settings."""
    steering = config.devices.steers()
    if steering is None:
        return {}
    driver = config.devices.present()[steering[0]].driver
    unit = getattr(driver, "unit", driver)
    names = ("front", "front_right", "rear", "rear_right")
    axles = {name: servo for name in names if isinstance(servo := getattr(unit, name, None), ServoPulses)}
    stop: float = ServoModelConfig.model_fields["left_stop_deg"].default
    servos: dict[str, dict[str, Any]] = {
        f"{name}_servo": {
            "channel": vars(servo)["channel"],
            "centre_us": servo.centre_us,
            "us_per_degree": servo.direction * servo.scale_us_per_deg,
            "left_stop_deg": max(servo.max_angle_deg, stop),
            "right_stop_deg": max(servo.max_angle_deg, stop),
        }
        for name, servo in axles.items()
    }
    if isinstance(servo := getattr(driver, "servo", None), VescServoConfig):
        low, span = 1000.0, 1000.0  # pulses of the positions 0 and 1 are 1 and 2 ms
        scale = servo.direction * servo.per_radian * span * math.radians(1.0)
        servos["front_servo"] = {"channel": 0, "centre_us": low + span * servo.centre, "us_per_degree": scale}
    taken = {servo["channel"] for servo in servos.values()}
    if "rear_servo" not in servos:  # it moves nothing, and is on no servo's channel
        servos["rear_servo"] = {"channel": next(channel for channel in range(6) if channel not in taken)}
    return servos


def _motor(config: TruckConfig) -> dict[str, Any]:
    """Return a motor that reaches its maximum rate and the body's pull with the configured pack."""
    geometry = config.geometry
    shafts = config.devices.shafts()
    found: dict[str, Any] = {"ratio": geometry.drive_ratio, "clutch_force": geometry.pull}
    if not shafts:
        return found
    driver = next(iter(shafts.values())).driver
    motors = getattr(driver, "motors", None)
    inverted = motors[0].inverted if isinstance(motors, tuple) else getattr(driver, "inverted", False)
    found["inverted"] = inverted[0] if isinstance(inverted, tuple) else inverted
    limits = motor_limits(driver)
    if limits is None:
        return found
    at_load, spare = 0.7, 1.5  # share of the pack's voltage at the greatest rate; of the pull
    rolling = 0.4  # deceleration without power, m/s^2
    volts = 3.7 * _pack(config).get("cells", 6)
    constant = at_load * volts / limits.rate
    efficiency = MotorConfig().efficiency
    current = spare * geometry.pull * geometry.wheel_radius / (geometry.drive_ratio * efficiency * constant)
    coasting = rolling / geometry.wheel_radius * geometry.drive_ratio * 60 / math.tau
    found |= {"torque_constant": constant, "peak_current": current, "coast_rpm_s": coasting}
    return found | {"winding_resistance": (1 - at_load) * volts / current}


def _pack(config: TruckConfig) -> dict[str, Any]:
    pack = next((pack for _, pack in packs(config.devices, config.monitors)), None)
    if pack is None:
        return {}
    inputs = {"channel": pack.channel} if isinstance(pack, BatteryInputConfig) else {}
    return {"cells": pack.cells, "capacity_ah": pack.capacity_ah} | inputs
