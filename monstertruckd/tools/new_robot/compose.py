"""Sections of a new robot's configuration, from its description; pure."""

import math
from collections.abc import Mapping
from typing import Any, Final

from monstertruck_drivers.battery.config import PackConfig
from monstertruck_drivers.catalog import DEVICES
from monstertruck_drivers.scanning.config import sheet
from monstertruck_drivers.usb.config import UsbPortConfig
from monstertruck_drivers.usb.tree import TreeSnapshot, parent_of, port_of
from monstertruck_kinematics.chassis import Chassis, Dimensions
from monstertruck_kinematics.truck import DriveTrain
from monstertruck_runtime.bodies import BODIES
from monstertruck_runtime.errors import InputError
from monstertruckd.config.device_safety import BY_CELLS, UNATTENDED
from monstertruckd.config.load import FILE_VERSION
from monstertruckd.gate.config import GateConfig, unattended
from monstertruckd.tools.install.files import LINKS
from monstertruckd.tools.new_robot.answers import NONE, Answers

Section = dict[str, Any]

MOTORS: Final = {"arduino_bridge": 2, "maestro_esc": 1, "pca9685_esc": 1}
"""Motors of controllers that drive fewer than four."""
WORLD: Final = "workshop"
"""Built-in world of the twin: a room of 5 m by 4 m with a store."""


def robot(answers: Answers, tree: TreeSnapshot, navigation: str) -> Section:
    """The configuration of the robot itself.

    Args:
        answers: description of the robot.
        tree: USB devices of this computer; a device that can only be of one kind gives that kind its port.
        navigation: file name of the part with mapping, planner, tracker and explorer.

    Raises:
        InputError: the controller does not drive as many motors as the body has.
    """
    chassis = _chassis(answers)
    drives, shafts = MOTORS.get(answers.drive, 4), len(chassis.shafts)
    if shafts > drives or (answers.drive == "arduino_bridge" and shafts != drives):
        motors = "one motor" if drives == 1 else f"{drives} motors"
        raise InputError(f"drive {answers.drive}: drives {motors}, body {answers.body} has {shafts}")
    found: Section = {"include": navigation} if answers.lidar != NONE else {}
    found |= {"version": FILE_VERSION, "robot": answers.name, "body": _body(answers)}
    found |= {"geometry": _geometry(answers), "devices": _with_ports(_devices(answers, chassis), tree)}
    if answers.battery == "iio":
        found["monitors"] = {"battery": {"kind": "iio"} | _pack(answers.cells)}
    found["gate"] = _gate(answers, chassis)
    tracker = _tracker(answers, chassis)
    found |= {"tracker": tracker, "odometry": {"max_speed": _rounded(1.5 * answers.speed)}}
    if answers.lidar != NONE:
        found |= _navigation(answers, chassis, tracker)
    return found | {"recorder": {"directory": "logs"}}


def simulated(answers: Answers) -> Section:
    """What the twin has in addition: emulated ports, and the robot as built in a world."""
    chassis = _chassis(answers)
    devices: Section = {role: {"port": None} for role in _devices(answers, chassis)}
    served = {"dead_time": 0.012, "lag": 0.0}  # of the emulated servos: serial line and half a frame of pulses
    if answers.steering == "drive":
        within = "servo" if answers.drive == "vesc" else "unit"
        devices["actuators"]["driver"] = {within: served}
    elif answers.steering != NONE:
        devices["steering"]["driver"] = served
    motor = {} if answers.drive == "epos" else {"motor": {"lag": 0.03, "drivetrain_lag": 0.03}}
    world: Section = {"map": WORLD} | ({"truck": motor} if motor else {})
    exact = {"position_noise": 0.0, "heading_noise": 0.0}
    sim = {"as_built": True, "stand": exact, "world": world}
    return {"version": FILE_VERSION, "devices": devices, "stand": "simulator", "sim": sim}


def twin(own: str, simulation: str) -> Section:
    """The twin: the robot's own file and the simulation."""
    return {"include": [own, simulation], "version": FILE_VERSION}


def _chassis(answers: Answers) -> Chassis:
    train = DriveTrain(answers.drive_ratio, answers.wheel_radius)
    body = {name: value for name, value in _body(answers).items() if name != "kind"}
    built: Chassis = BODIES[answers.body].build(Dimensions(train, answers.wheelbase, answers.track), **body)
    return built


def _body(answers: Answers) -> Section:
    match answers.body:
        case "omni":
            return {"kind": "omni", "circle": _rounded(answers.track / math.sqrt(3))}
        case "independent":
            return {"kind": "independent", "steering": "wheels"}
        case _:
            return {"kind": answers.body}


def _geometry(answers: Answers) -> Section:
    names = ("wheelbase", "track", "wheel_radius", "drive_ratio", "length", "width", "mass")
    spare = 1.5
    pull = answers.pull or _rounded(spare * 1.25 * answers.braking * answers.mass)
    return {name: getattr(answers, name) for name in names} | {"pull": pull}


# Devices


def _devices(answers: Answers, chassis: Chassis) -> Section:
    found: Section = {}
    if answers.lidar != NONE:
        found["lidar"] = {"mount": {"x": answers.lidar_x, "z": answers.lidar_z}, "driver": answers.lidar_driver}
    found |= _drives(answers, chassis)
    if answers.steering in ("maestro", "pca9685"):
        driver: Section = {"kind": answers.steering} | _axles(answers, chassis)
        if answers.steering == "maestro":
            driver["battery"] = _pack(answers.cells) if answers.battery == "steering" else None
        found["steering"] = {"driver": _in_time(driver, answers)}
    if answers.attitude != NONE:
        found[DEVICES[answers.attitude].role.name] = {"driver": {"kind": answers.attitude}}
    if answers.camera != NONE:
        mount = {"x": answers.camera_x, "z": answers.camera_z}
        found["camera"] = {"mount": mount, "driver": {"kind": answers.camera}}
    return found


def _drives(answers: Answers, chassis: Chassis) -> Section:
    """Controllers of the driven shafts; a little faster and harder than the gate asks."""
    spare, quick, count = 1.05, 1.25, len(chassis.shafts)
    per_metre = answers.drive_ratio / answers.wheel_radius
    rate, slowing = spare * answers.speed * per_metre, spare * answers.braking * per_metre
    rpm = 60 / math.tau
    kind: Section = {"kind": answers.drive}
    match answers.drive:
        case "vesc":
            battery = {"battery": _pack(answers.cells)} if answers.battery == "drive" else {}
            servo = {"servo": {"per_radian": 0.6, "min": 0.1, "max": 0.9}} if answers.steering == "drive" else {}
            motors = [{"can_id": None if i == 0 else i} for i in range(count)]
            limits = {"max_motor_rpm": math.ceil(rate * rpm), "deceleration_rpm_s": _rounded(slowing * rpm)}
            limits |= {"quick_stop_deceleration_rpm_s": _rounded(quick * slowing * rpm)}
            return {"actuators": {"driver": _in_time(kind | {"motors": motors} | limits | battery | servo, answers)}}
        case "arduino_bridge":
            limits = {"max_rate": _rounded(rate), "deceleration": _rounded(slowing)}
            limits |= {"quick_deceleration": _rounded(quick * slowing), "auto_stop": 0.25}
            return {"wheels": {"driver": _in_time(kind | limits, answers)}}
        case "steppers":
            steps = 400 / math.tau  # default of steps_per_turn
            limits = {"motors": count, "max_rate": _rounded(rate * steps), "acceleration": math.ceil(slowing * steps)}
            limits |= {"quick_deceleration": math.ceil(quick * slowing * steps)}
            return {"wheels": {"driver": _in_time(kind | limits, answers)}}
        case "epos":
            limits = {"max_motor_rpm": math.ceil(rate * rpm), "deceleration_rpm_s": math.ceil(slowing * rpm)}
            limits |= {"quick_stop_deceleration_rpm_s": math.ceil(quick * slowing * rpm), "inverted": False}
            roles = ("drive", "drive_2", "drive_3", "drive_4")[:count]
            return {role: {"driver": _in_time(kind | limits, answers)} for role in roles}
        case _:
            esc = {"max_rate": _rounded(rate), "deceleration": _rounded(slowing)}
            esc |= {"quick_deceleration": _rounded(quick * slowing)}
            unit: Section = {"kind": answers.drive.removesuffix("_esc")} | _axles(answers, chassis)
            if answers.drive == "maestro_esc":
                unit["battery"] = _pack(answers.cells) if answers.battery == "drive" else None
            return {"actuators": {"driver": kind | {"esc": {"channel": 2} | esc, "unit": _in_time(unit, answers)}}}


def _axles(answers: Answers, chassis: Chassis) -> Section:
    """Return the servo settings of the axles; those of the truck's linkage are the drivers' defaults."""
    if not chassis.steered:
        return {}
    if answers.body == "truck":
        return {"front": {"channel": 1}, "rear": {"channel": 0}}
    names = ("scale_us_per_deg", "min_us", "max_us", "max_angle_deg")
    turns_far = answers.body in ("synchro", "independent")  # to both sides, so that wheels point anywhere
    pulses = dict(zip(names, (5.0, 1000.0, 2000.0, 100.0) if turns_far else (10.0, 1100.0, 1900.0, 35.0), strict=True))
    wheels = ("front", "front_right", "rear", "rear_right") if answers.body == "independent" else ("front",)
    at_once: Section = {"speed": 0} if turns_far and answers.steering == "maestro" else {}
    servo = {"centre_us": 1500.0} | pulses | at_once
    return {wheel: {"channel": channel} | servo for channel, wheel in enumerate(wheels, 1)}


def _in_time(driver: Section, answers: Answers) -> Section:
    """The settings, with times as short as the robot's length takes at its speed."""
    longest = _longest(answers)
    settings = DEVICES[driver["kind"]].settings_class()
    defaults = settings.model_validate(driver, strict=False)
    late = {name: longest for name in UNATTENDED.get(settings, ()) if getattr(defaults, name) > longest}
    return driver | late


def _longest(answers: Answers) -> float:
    """Longest time without news from a device (s)."""
    spare = 0.95
    return math.floor(1000 * spare * answers.length / answers.speed) / 1000


def _pack(cells: int) -> Section:
    """Return the settings of a pack with ``cells`` cells, scaled from the limits of the default pack."""
    usual = PackConfig()
    names = (*BY_CELLS, "plausible_min")
    volts: Section = {name: round(getattr(usual, name) / usual.cells * cells, 2) for name in names}
    return {"cells": cells} | volts


def _with_ports(devices: Section, tree: TreeSnapshot) -> Section:
    """Each device with its port: the only fitting USB device of this computer, or the link that udev will make."""
    fitting: dict[str, list[str]] = {}
    wanted: dict[str, list[str]] = {}
    for role, device in devices.items():
        if (usb := DEVICES[device["driver"]["kind"]].usb) is not None:
            wanted.setdefault(usb.usb_id, []).append(role)
            fitting[usb.usb_id] = [name for name, one in tree.devices.items() if one.usb_id == usb.usb_id and one.nodes]
    alone = {roles[0]: fitting[usb][0] for usb, roles in wanted.items() if len(roles) == len(fitting[usb]) == 1}
    ports = {role: _port(role, device["driver"], alone.get(role), tree) for role, device in devices.items()}
    return {role: {"port": ports[role]} | device for role, device in devices.items()}


def _port(role: str, driver: Mapping[str, Any], usb: str | None, tree: TreeSnapshot) -> Section:
    kind = str(driver["kind"])
    if usb is not None:
        port = UsbPortConfig(hub=str(parent_of(usb)), port=port_of(usb), usb_id=tree.devices[usb].usb_id)
        return port.model_dump(include={"hub", "port", "usb_id"})
    if kind == "hokuyo_lx":
        return {"address": "192.168.0.10", "tcp": 10940}
    if kind == "mjpeg":
        return {"command": ["rpicam-vid", "-n", "-t", "0", "--codec", "mjpeg", "-o", "-"]}
    if DEVICES[kind].opens == "i2c":
        return {"path": "/dev/i2c-1"}
    motor = {"dtr": False} if kind == "rplidar" else {}  # lets the motor of an A1 turn
    return {"path": str(LINKS / role)} | motor


# Driving


def _gate(answers: Answers, chassis: Chassis) -> Section:
    longest, usual = _longest(answers), GateConfig()
    found: Section = {
        "speed": answers.speed,
        "reverse_speed": _rounded(0.5 * answers.speed),
        "acceleration": _rounded(0.8 * answers.braking),
        "deceleration": _rounded(answers.braking),
        "quick_deceleration": _rounded(1.25 * answers.braking),
        "obstacle": {"deceleration": min(_rounded(0.5 * answers.braking), 2.5)},
    }
    if chassis.steered:
        found["steering_rate"] = 2.0
    for name, seconds in unattended(usual):
        if seconds > longest:
            _put(found, name.split(".")[1:], longest)
    if answers.attitude in (NONE, "wt61"):
        found["attitude"] = None
    if answers.lidar == NONE:  # nothing but its own length bounds where it must have stopped
        found["scan"] = {"stale_after": min(0.15, longest), "critical": False}
        found["max_latency"] = min(0.2, longest)
    return found


def _put(section: Section, key: list[str], value: Any) -> None:
    for part in key[:-1]:
        section = section.setdefault(part, {})
    section[key[-1]] = value


def _tracker(answers: Answers, chassis: Chassis) -> Section:
    return {
        "kind": "lqr",
        "steering": {"both": "counter", "front": "front", "parallel": "crab"}[chassis.freedom],
        "speed": answers.speed,
        "reverse_speed": _rounded(0.4 * answers.speed),
        "acceleration": _rounded(0.6 * answers.braking),
        "deceleration": _rounded(0.4 * answers.braking),
        "lateral_acceleration": 1.0,
    }


def _navigation(answers: Answers, chassis: Chassis, tracker: Section) -> Section:
    """What differs from the part for mapping and exploring."""
    lidar = answers.lidar_driver
    settings = DEVICES[answers.lidar_kind].settings_class().model_validate(lidar, strict=False)
    reach = sheet(settings).sure
    noticed = 0.3  # seconds until three scans have shown the route blocked
    stop = answers.speed * noticed + answers.speed**2 / (2 * tracker["deceleration"])
    views = {"hokuyo_urg": math.radians(239.0), "hokuyo_lx": math.radians(270.0)}
    view = lidar.get("field_of_view", views.get(answers.lidar_kind, math.tau))
    found: Section = {
        "planner": {
            "steering": "4ws" if chassis.freedom == "both" else "2ws",
            "look_ahead": max(1.5, math.ceil(11 * stop) / 10),
        },
        "slam": {"save": f"runs/{answers.name}", "grid": {"passed": None}},
        "explorer": {"reach": min(reach, 12.0), "view": round(view, 3)},
    }
    if chassis.freedom == "parallel":  # no route turns with such a body
        found |= {"planner": None, "explorer": None}
    return found | ({} if answers.camera != NONE else {"points": None})


def _rounded(value: float) -> float:
    """``value`` to three figures, upwards."""
    digits = 2 - math.floor(math.log10(value))
    scale: float = 10.0**digits
    return round(math.ceil(value * scale - 1e-9) / scale, max(digits, 0))
