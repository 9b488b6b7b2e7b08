"""Checks of the robot's own files: its calibration and its latest log."""

import math
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

import numpy as np

from monstertruck_drivers.usb.config import UsbPortConfig
from monstertruck_drivers.usb.tree import read_tree
from monstertruck_runtime.errors import ConfigError, TruckError
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.topics import CMD_STEERING, COMPASS, EVENT, IMU, ODOMETRY
from monstertruckd.config.calibration import CalibrationStore
from monstertruckd.config.expiry import DistanceCounter, state_of
from monstertruckd.recorder.reader import open_log
from monstertruckd.tools.doctor.context import Finding, HostContext, fail, fine, warn

AT_LIMIT: Final = math.radians(0.5)
COUNTED: Final = {
    Reason.DEVICE_RESTARTED: (
        "brown-out",
        "a device lost its supply and came back: measure the voltage while the motor starts",
    ),
    Reason.CLOCK_STEPPED: (
        "clock steps",
        "the system time jumped: set the clock before the drive, or log dates are wrong",
    ),
    Reason.HOST_THROTTLED: ("throttled", "the processor was throttled: cool it, and measure its supply"),
    Reason.OVER_CURRENT: ("over-current", "a hub's port was overloaded: use a supplied hub"),
}
"""Events of a log that are findings, with their check and meaning."""


def calibration(context: HostContext) -> Iterator[Finding]:
    """Check quality and age of each wizard's values."""
    config = context.config
    if config is None:
        return
    folder = config.calibration_folder
    place = context.at(folder) if folder.is_absolute() else context.logs().parent / folder
    try:
        file = CalibrationStore(place, config.robot).current()
    except ConfigError as error:
        yield fail("calibration", Reason.BAD_CONFIG, str(error))
        return
    everything = context.command("calibrate", "all")
    if file is None:
        yield warn("calibration", Reason.CALIBRATION_EXPIRED, f"none in {place}", everything)
        return
    counter = DistanceCounter(place.parent / "odometer.json")
    counter.load()
    clock = context.computer.machine.clock
    now = clock.now() + clock.real_offset()
    tree, ports = read_tree(context.computer.machine.sysfs), config.devices.present()
    plugged = {
        role: device.serial
        for role, entry in ports.items()
        if isinstance(entry.port, UsbPortConfig)
        and (device := tree.devices.get(tree.at_present(entry.port.device))) is not None
    }
    serials = {role: serial for role, serial in plugged.items() if serial is not None}
    for name, result in file.results.items():
        state = state_of(result, config, now, counter.metres, serials)
        again = context.command("calibrate", name)
        if state.expired:
            yield warn(f"calibration {name}", Reason.CALIBRATION_EXPIRED, state.expired, again)
        elif state.grade == "C":
            seen = "grade C: its intervals are more than twice as wide as intended"
            yield warn(f"calibration {name}", Reason.CALIBRATION_EXPIRED, seen, again)
        else:
            yield fine(f"calibration {name}", f"grade {state.grade}, valid until {state.until[:10]}")


def newest_log(context: HostContext) -> Iterator[Finding]:
    """Check supply, clocks, steering and signs of sensors in the latest log."""
    newest = max(context.logs().glob("*.mcap"), key=lambda path: path.stat().st_mtime, default=None)
    if newest is None or newest.stat().st_size > 200_000_000:  # longer logs are left to `log report`
        return
    try:
        yield from log_findings(newest)
    except TruckError as error:
        yield warn("log", error.reason, str(error), context.command("log", "recover", str(newest)))


def log_findings(path: Path) -> Iterator[Finding]:
    """Yield the findings of one log.

    Raises:
        InputError: it is not a log.
    """
    events: Counter[Reason] = Counter()
    series: dict[str, list[tuple[float, float]]] = {topic.name: [] for topic in (COMPASS, ODOMETRY, IMU)}
    angles: list[tuple[float, float]] = []
    for entry in open_log(path):
        if entry.topic == EVENT.name:
            events[_message(entry).reason] += 1
        elif entry.topic == COMPASS.name:
            message = _message(entry)
            series[COMPASS.name].append((message.stamp, -message.heading))
        elif entry.topic == ODOMETRY.name:
            message = _message(entry)
            series[ODOMETRY.name].append((message.stamp, message.pose.yaw))
        elif entry.topic == IMU.name:
            message = _message(entry)
            series[IMU.name].append((message.stamp, message.angular_velocity.z))
        elif entry.topic == CMD_STEERING.name:
            message = _message(entry)
            angles.append((message.front, message.rear))
    for reason, (check, text) in COUNTED.items():
        if count := events[reason]:
            yield warn(check, reason, f"{count} in {path.name}: {text}")
    yield from _saturated(angles, path.name)
    yield from _signs({name: np.array(rows) for name, rows in series.items() if len(rows) > 2}, path.name)


def _saturated(angles: list[tuple[float, float]], log: str) -> Iterator[Finding]:
    """Find steering at its limit for much of the drive: a small limit, or wheels off centre."""
    if len(angles) < 100:
        return
    for axle, column in zip(("front", "rear"), np.abs(np.array(angles)).T, strict=True):
        most = float(column.max())
        share = float((column > most - AT_LIMIT).mean())
        if most > math.radians(5.0) and share > 0.2:  # share of the commands at a limit of an axle
            where = f"{axle} at its limit of {math.degrees(most):.0f} degrees for {share:.0%} of {log}"
            seen = f"{where}: calibrate the steering, or drive wider turns"
            yield warn("steering", Reason.SERVO_LIMIT, seen)


def _signs(series: dict[str, Any], log: str) -> Iterator[Finding]:
    """Find turns by compass, IMU and wheels in opposite directions."""
    if ODOMETRY.name not in series:
        return
    wheels = series[ODOMETRY.name]
    own = np.unwrap(wheels[:, 1])
    for name, what in ((COMPASS.name, "compass"), (IMU.name, "IMU")):
        if name not in series:
            continue
        rows = series[name]
        if name == IMU.name:
            yaw = np.concatenate(([0.0], np.cumsum(np.diff(rows[:, 0]) * 1e-9 * (rows[1:, 1] + rows[:-1, 1]) / 2)))
        else:
            yaw = np.unwrap(rows[:, 1])
        steps = np.diff(np.interp(wheels[::20, 0], rows[:, 0], yaw)), np.diff(own[::20])
        turned = float(np.abs(steps[1]).sum())
        if turned < 1.0:  # least turn in all to determine a sign, rad
            continue
        agreement = float(steps[0] @ steps[1]) / max(float(np.linalg.norm(steps[0]) * np.linalg.norm(steps[1])), 1e-12)
        if agreement < -0.5:
            yield fail(
                f"sign {what}",
                Reason.STEERING_DEAD,
                f"in {log} it turns opposite to the wheels: mounted upside down, or the wheels' "
                "directions are wrong (calibrate drive --sign-only, calibrate steering --rough)",
            )
        elif agreement > 0.5:
            yield fine(f"sign {what}", "turns like the wheels")


def _message(entry: Any) -> Any:
    return entry.decode()
