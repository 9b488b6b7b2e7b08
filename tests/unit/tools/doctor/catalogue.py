"""Faults of a computer that `doctor` has to find, each with what it is to say about it."""

import json
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from monstertruck_runtime import wire
from monstertruck_runtime.clock import SECOND, VirtualClock, run_virtual
from monstertruck_schemas.base import Message
from monstertruck_schemas.cmd import SteeringCommand
from monstertruck_schemas.event import Event, Severity
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.sensor import Attitude, Imu, Vector3
from monstertruck_schemas.state import Odometry, Pose2D, Twist2D
from monstertruck_schemas.topics import CMD_STEERING, COMPASS, EVENT, IMU, ODOMETRY, Topic
from monstertruckd.config.calibration import CalibrationStore, Estimate, Result
from monstertruckd.config.expiry import stamped
from monstertruckd.recorder.config import RecorderConfig
from monstertruckd.recorder.log_file import LogEntry
from monstertruckd.recorder.recorder import LogWriter
from monstertruckd.tools.doctor import examine
from monstertruckd.tools.doctor.context import Account, Finding, Level, inspect
from monstertruckd.tools.install.plan import RULES, UNIT
from tests.unit.tools.doctor.kit import NOW, EmulatedHost, emulated
from tests.unit.tools.doctor.test_host import with_tls
from tests.unit.tools.install.kit import PROGRAM

DAY = 86_400
WIRELESS = "etc/NetworkManager/system-connections"


@dataclass(frozen=True)
class Fault:
    """Something that is wrong."""

    name: str
    change: Callable[[EmulatedHost], Any]
    """Makes it so."""
    check: str
    """Name of the finding."""
    reason: Reason
    mend: str
    """In the command that mends it, or in what the finding says."""
    touches: frozenset[str] = field(default_factory=frozenset)
    """Faults that touch the same hide each other; empty: it hides all others."""
    also: frozenset[str] = frozenset()
    """Checks that it spoils as well, rightly."""


def _on(*things: str) -> frozenset[str]:
    return frozenset(things)


def calibrated(made: EmulatedHost, half: float = 3.0, days: int = 10, serial: str = "") -> None:
    """A drive that was measured so well, so long ago."""
    assert made.context.config is not None
    folder = made.context.logs().parent / made.context.config.calibration_folder
    estimate = Estimate(name="drive_ratio", value=600.0, low=600 - half, high=600 + half, samples=4, meaning="test")
    result = Result(wizard="drive", measured="test", estimates=(estimate,))
    when = round((NOW - days * DAY) * SECOND)
    saved = stamped(result, made.context.config, when, 0.0, {"drive": serial})
    CalibrationStore(folder, made.context.config.robot).save(saved, when)


def _calibration_file(made: EmulatedHost) -> Path:
    assert made.context.config is not None
    folder = made.context.logs().parent / made.context.config.calibration_folder
    return max(folder.glob("*.json"))


def _uncalibrated(made: EmulatedHost) -> None:
    _calibration_file(made).unlink()


def _of_another_truck(made: EmulatedHost) -> None:
    file = _calibration_file(made)
    file.write_text(json.dumps(json.loads(file.read_text()) | {"robot": "another"}))


def _other_adapter(made: EmulatedHost) -> None:
    made.computer.usb.unplug("1-1.1")
    made.computer.usb.add_device("1-1.1", "0403:6001", "FT232R USB UART", serial="B2", node="ttyUSB")
    for file in made.latencies:
        file.write_text("1")
    for node in (made.folder / "dev").glob("ttyUSB*"):
        node.chmod(0o660)
    calibrated(made, serial="A1")


def _unplug(place: str) -> Callable[[EmulatedHost], None]:
    return lambda made: made.computer.usb.unplug(place)


def _replace(place: str, usb_id: str, **node: Any) -> Callable[[EmulatedHost], None]:
    def change(made: EmulatedHost) -> None:
        made.computer.usb.unplug(place)
        made.computer.usb.add_device(place, usb_id, **node)

    return change


def _latency(index: int) -> Callable[[EmulatedHost], None]:
    return lambda made: made.latencies[index].write_text("16") and None


def _remove(path: Path | str) -> Callable[[EmulatedHost], None]:
    return lambda made: (made.folder / str(path).lstrip("/")).unlink()


def _put(path: Path | str, text: str) -> Callable[[EmulatedHost], None]:
    return lambda made: made.put(str(path).lstrip("/"), text) and None


def _says(said: str) -> Callable[[EmulatedHost], None]:
    return lambda made: made.runs(systemctl=(0, said))


def _modem_manager(made: EmulatedHost) -> None:
    _remove(RULES)(made)
    made.process(77, "/usr/sbin/ModemManager")


def _user(account: Account | None) -> Callable[[EmulatedHost], None]:
    def change(made: EmulatedHost) -> None:
        made.context = replace(made.context, account=account)

    return change


def _closed_logs(made: EmulatedHost) -> None:
    made.context.logs().chmod(0o500)


def _lacks(*names: str) -> Callable[[EmulatedHost], None]:
    def change(made: EmulatedHost) -> None:
        made.context = replace(made.context, versions=lambda name: None if name in names else "1.0")

    return change


def _refused(made: EmulatedHost) -> None:
    made.put("etc/monstertruckd/truck.yaml", "version: 1\ndevices: {}\nspeed: 9\n")
    made.context = inspect(made.folder, PROGRAM, None, 0, made.clock)


def _small_disk(made: EmulatedHost) -> None:
    made.change(monitors={"host": {"kind": "host_health", "disk": 10**18, "disk_clear": 10**18 + 1}})


def _card(life: str, end: str) -> Callable[[EmulatedHost], None]:
    def change(made: EmulatedHost) -> None:
        made.put("sys/block/mmcblk0/device/life_time", life + "\n")
        made.put("sys/block/mmcblk0/device/pre_eol_info", end + "\n")

    return change


def _port_taken(made: EmulatedHost) -> None:
    row = "   0: 0100007F:1D17 00000000:0000 0A 00000000:00000000 00:00000000 00000000     0        0 1"
    made.put("proc/net/tcp", f"  sl  local_address rem_address   st\n{row}\n")


def _with_tls(change: Callable[[EmulatedHost], Any] = lambda _: None, **days: int) -> Callable[[EmulatedHost], None]:
    """Certificates of a robot whose service may read them, then ``change``."""

    def made_so(made: EmulatedHost) -> None:
        with_tls(made, mode=0o600, **days)
        account = made.context.account
        assert account is not None
        made.context = replace(made.context, account=replace(account, uid=(made.folder / "pki").stat().st_uid))
        change(made)

    return made_so


def log(*messages: tuple[Topic[Any], Message]) -> Callable[[EmulatedHost], None]:
    """A log with these messages."""

    def change(made: EmulatedHost) -> None:
        config = RecorderConfig(directory=str(made.context.logs()))
        with LogWriter(config, {}, {}, 0) as writer:
            for number, (topic, message) in enumerate(messages):
                data = wire.encode(topic, message)
                writer.write(LogEntry(topic, message.stamp, message.stamp, number, data))

    return change


def _header(time: float) -> dict[str, int]:
    return {"stamp": round(time * SECOND), "received": round(time * SECOND), "seq": 0}


def event(reason: Reason) -> tuple[Topic[Any], Message]:
    """Something that happened once."""
    return EVENT, Event(**_header(1.0), reason=reason, severity=Severity.WARNING, source="test")


def weaving(*, compass: int = 1, imu: int = 1, limit: float = 1.0) -> list[tuple[Topic[Any], Message]]:
    """Twenty seconds of a truck that turns to and fro, as its wheels, compass and IMU saw it.

    Args:
        compass: -1: it turns against the wheels.
        imu: the same.
        limit: share of the steering's way at which it stops.
    """
    found: list[tuple[Topic[Any], Message]] = []
    nothing = np.zeros(9)
    for t in np.arange(0.0, 20.0, 0.05).tolist():
        head, yaw, rate = _header(t), math.sin(t), math.cos(t)
        pose, twist = Pose2D(x=0.0, y=0.0, yaw=yaw), Twist2D(vx=0.0, vy=0.0, wz=rate)
        angle = 0.35 * min(max(math.cos(t), -limit), limit)
        turn, none = Vector3(x=0.0, y=0.0, z=imu * rate), Vector3(x=0.0, y=0.0, z=9.81)
        found += [
            (
                ODOMETRY,
                Odometry(
                    **head, frame="odom", pose=pose, twist=twist, pose_covariance=nothing, twist_covariance=nothing,
                    age=0.0,
                ),
            ),
            (COMPASS, Attitude(**head, heading=(-compass * yaw) % math.tau, pitch=0.0, roll=0.0)),
            (IMU, Imu(**head, frame="imu", angular_velocity=turn, linear_acceleration=none)),
            (CMD_STEERING, SteeringCommand(**head, front=angle, rear=-angle, front_servo=0.0, rear_servo=0.0)),
        ]  # fmt: skip
    return found


PLACES = {"drive": "1-1.1", "steering": "1-1.2", "compass": "1-1.3", "stabiliser": "1-1.4", "lidar": "1-2.1",
          "camera": "1-2.2"}  # fmt: skip
ELSEWHERE = {"lidar": "1-2.4", "steering": "1-2.3"}
OPEN = {"listen": ("tcp/0.0.0.0:7447",), "insecure": True}

FAULTS: tuple[Fault, ...] = (
    *(
        Fault(f"{role} unplugged", _unplug(place), role, Reason.DEVICE_LOST, f"find-port {role}", _on(role))
        for role, place in PLACES.items()
        if role not in ("drive", "stabiliser")  # the one adapter hides the other, as both are of one kind
    ),
    *(
        Fault(
            f"{role} on another port",
            lambda made, role=role, to=to: made.computer.usb.move(PLACES[role], to),
            role,
            Reason.PORT_MOVED,
            f"find-port {role}",
            _on(role),
        )
        for role, to in ELSEWHERE.items()
    ),
    *(
        Fault(
            f"another device for the {role}",
            _replace(PLACES[role], "1d50:6018", node="ttyACM"),
            role,
            Reason.DEVICE_WRONG,
            f"find-port {role}",
            _on(role),
        )
        for role in ("drive", "steering", "stabiliser", "lidar")
    ),
    *(
        Fault(
            f"no kernel module for the {role}",
            _replace(PLACES[role], usb_id),
            role,
            Reason.DEVICE_LOST,
            f"modprobe {module}",
            _on(role),
        )
        for role, usb_id, module in (
            ("drive", "0403:6001", "ftdi_sio"),
            ("lidar", "15d1:0000", "cdc_acm"),
            ("camera", "046d:080a", "uvcvideo"),
        )
    ),
    Fault(
        "hub without supply",
        lambda made: made.computer.usb.lose_hub("1-2"),
        "lidar",
        Reason.HUB_LOST,
        "usb --local",
        _on("lidar", "camera"),
        _on("camera"),
    ),
    Fault("slow adapter", _latency(0), "drive latency", Reason.SLOW_LINK, "latency_timer", _on("drive")),
    *(
        Fault(
            f"{role} falls asleep",
            lambda made, role=role: made.computer.usb.suspend_when_idle(PLACES[role]),
            f"{role} power",
            Reason.AUTOSUSPEND,
            "power/control",
            _on(role),
        )
        for role in ("steering", "lidar")
    ),
    *(
        Fault(
            f"port of the {role} overloaded",
            lambda made, role=role: made.computer.usb.over_current(PLACES[role]),
            "over-current",
            Reason.OVER_CURRENT,
            "self-powered hub",
            _on(role),
        )
        for role in ("camera", "steering")
    ),
    Fault("package missing", _lacks("mcap"), "packages", Reason.NOT_INSTALLED, "pip install", _on("packages")),
    Fault("configuration refused", _refused, "config", Reason.BAD_CONFIG, "config show", also=_on("user")),
    Fault(
        "limits weakened",
        lambda made: made.change(gate={"tilt": {"stop": 0.5}}),
        "safety",
        Reason.WEAKENED,
        "config show",
        _on("gate"),
    ),
    Fault(
        "service not installed",
        _remove(UNIT),
        "service",
        Reason.NOT_INSTALLED,
        "install-service",
        also=_on("calibration", "logs"),  # their folders are then below the caller's
    ),
    Fault(
        "service of an older release",
        _put(UNIT, "[Service]\nUser=monstertruckd\n"),
        "service",
        Reason.NOT_INSTALLED,
        "install-service",
        _on("unit"),
    ),
    Fault(
        "service failed",
        _says("ActiveState=failed\nNRestarts=2"),
        "service runs",
        Reason.SERVICE_FAILED,
        "journalctl",
        _on("systemd"),
    ),
    Fault(
        "service restarts",
        _says("ActiveState=active\nNRestarts=7"),
        "service runs",
        Reason.SERVICE_FAILED,
        "journalctl",
        _on("systemd"),
    ),
    Fault(
        "udev rules missing",
        _remove(RULES),
        "udev rules",
        Reason.NOT_INSTALLED,
        "install-service",
        _on("unit"),
        _on("service"),
    ),
    Fault(
        "udev rules of yesterday",
        _put(RULES, "# of yesterday\n"),
        "udev rules",
        Reason.NOT_INSTALLED,
        "install-service",
        _on("unit"),
        _on("service"),
    ),
    Fault(
        "ModemManager speaks to the ports",
        _modem_manager,
        "ModemManager",
        Reason.NOT_INSTALLED,
        "install-service",
        _on("unit"),
        _on("service", "udev rules"),
    ),
    Fault("no user for the service", _user(None), "user", Reason.NOT_PERMITTED, "install-service"),
    Fault(
        "user without groups",
        _user(Account("pi", 64_998, {"pi": 64_998})),
        "user",
        Reason.NOT_PERMITTED,
        "usermod -aG dialout,video pi",
        also=_on("service", "logs", *(f"{role} rights" for role in PLACES)),
    ),
    Fault(
        "node closed",
        lambda made: (made.folder / "dev/ttyUSB0").chmod(0o600),
        "drive rights",
        Reason.NOT_PERMITTED,
        "chmod g+rw",
        _on("drive"),
    ),
    Fault("folder of logs closed", _closed_logs, "logs", Reason.RECORDING_FAILED, "chown", _on("log")),
    Fault(
        "clock not kept",
        _remove("run/systemd/timesync/synchronized"),
        "clock",
        Reason.CLOCK_UNSET,
        "set-ntp",
        _on("clock"),
    ),
    Fault("clock never set", lambda made: made.clock.step_real(-NOW), "clock", Reason.CLOCK_UNSET, "set-ntp"),
    Fault("disk full", _small_disk, "disk", Reason.DISK_LOW, "du -xh", _on("monitors")),
    Fault(
        "memory full",
        lambda made: made.host.inject("memory", "0.04"),
        "memory",
        Reason.MEMORY_LOW,
        "ps -eo",
        _on("host"),
    ),
    Fault(
        "too hot",
        lambda made: made.host.inject("temperature", "91"),
        "heat",
        Reason.HOST_HOT,
        "ventilation",
        _on("host"),
    ),
    Fault(
        "throttled", lambda made: made.host.inject("cap", "0.5"), "heat", Reason.HOST_THROTTLED, "cpufreq", _on("host")
    ),
    Fault(
        "weak radio", lambda made: made.network.inject("signal", "-82"), "link", Reason.LINK_WEAK, "iw dev", _on("link")
    ),
    Fault(
        "no radio", lambda made: made.network.inject("wifi", "off"), "link", Reason.LINK_DOWN, "ip -brief", _on("link")
    ),
    Fault(
        "open network",
        _put(f"{WIRELESS}/cafe.nmconnection", "[wifi]\nssid=cafe\n"),
        "wireless",
        Reason.LINK_OPEN,
        "use WPA2",
        _on("wireless"),
    ),
    Fault(
        "WEP",
        _put(f"{WIRELESS}/old.nmconnection", "[wifi]\n[wifi-security]\nkey-mgmt=none\nwep-key0=x\n"),
        "wireless",
        Reason.LINK_OPEN,
        "use WPA2",
        _on("wireless"),
    ),
    Fault(
        "open network of wpa_supplicant",
        _put("etc/wpa_supplicant/wpa_supplicant.conf", 'network={\n ssid="hall"\n key_mgmt=NONE\n}\n'),
        "wireless",
        Reason.LINK_OPEN,
        "use WPA2",
        _on("wireless"),
    ),
    Fault(
        "truck open to everybody",
        lambda made: made.change(zenoh=OPEN),
        "access",
        Reason.LINK_OPEN,
        "zenoh.tls",
        _on("zenoh"),
        _on("safety"),
    ),
    Fault("port taken", _port_taken, "port", Reason.BUSY, "ss -ltnp", _on("zenoh")),
    Fault(
        "certificate missing",
        _with_tls(_remove("pki/robot.pem")),
        "tls",
        Reason.NOT_FOUND,
        "security show",
        _on("zenoh", "log", "drive"),
    ),
    Fault(
        "no certificate in its file",
        _with_tls(_put("pki/robot.pem", "no certificate")),
        "certificate",
        Reason.BAD_INPUT,
        "security show",
        _on("zenoh", "log", "drive"),
    ),
    Fault(
        "certificate ends soon",
        _with_tls(robot_days=20),
        "certificate",
        Reason.NOT_PERMITTED,
        "security show",
        _on("zenoh", "log", "drive"),
    ),
    Fault(
        "pilot's certificate has ended",
        _with_tls(anna_days=-2),
        "certificate",
        Reason.NOT_PERMITTED,
        "security show",
        _on("zenoh", "log", "drive"),
    ),
    Fault(
        "private key for everybody",
        _with_tls(lambda made: (made.folder / "pki/robot.key").chmod(0o644)),
        "tls",
        Reason.LINK_OPEN,
        "chmod 600",
        _on("zenoh", "log", "drive"),
    ),
    Fault("card worn", _card("0x02 0x09", "0x01"), "card", Reason.RECORDING_FAILED, "copy it", _on("card")),
    Fault("card at its end", _card("0x03 0x03", "0x02"), "card", Reason.RECORDING_FAILED, "copy it", _on("card")),
    Fault(
        "not calibrated", _uncalibrated, "calibration", Reason.CALIBRATION_EXPIRED, "calibrate all", _on("calibration")
    ),
    Fault(
        "calibration of another truck",
        _of_another_truck,
        "calibration",
        Reason.BAD_CONFIG,
        "another",
        _on("calibration"),
    ),
    Fault(
        "calibration old",
        lambda made: calibrated(made, days=400),
        "calibration drive",
        Reason.CALIBRATION_EXPIRED,
        "calibrate drive",
        _on("calibration"),
    ),
    Fault(
        "calibration poor",
        lambda made: calibrated(made, half=20.0),
        "calibration drive",
        Reason.CALIBRATION_EXPIRED,
        "calibrate drive",
        _on("calibration"),
    ),
    Fault(
        "adapter replaced",
        _other_adapter,
        "calibration drive",
        Reason.CALIBRATION_EXPIRED,
        "calibrate drive",
        _on("calibration", "drive"),
    ),
    Fault(
        "log damaged",
        lambda made: (made.context.logs() / "run.mcap").write_bytes(b"no log") and None,
        "log",
        Reason.BAD_INPUT,
        "log recover",
        _on("log"),
    ),
    *(
        Fault(f"log: {check}", log(event(reason)), check, reason, mend, _on("log"))
        for check, reason, mend in (
            ("brown-out", Reason.DEVICE_RESTARTED, "measure the voltage"),
            ("clock steps", Reason.CLOCK_STEPPED, "set the clock before"),
            ("throttled", Reason.HOST_THROTTLED, "measure its supply"),
            ("over-current", Reason.OVER_CURRENT, "use a supplied hub"),
        )
    ),
    Fault(
        "steering saturated",
        log(*weaving(limit=0.5)),
        "steering",
        Reason.SERVO_LIMIT,
        "calibrate the steering",
        _on("log", "steering"),
    ),
    Fault(
        "compass turned over",
        log(*weaving(compass=-1)),
        "sign compass",
        Reason.STEERING_DEAD,
        "upside down",
        _on("log"),
    ),
    Fault("IMU turned over", log(*weaving(imu=-1)), "sign IMU", Reason.STEERING_DEAD, "upside down", _on("log")),
)


def examined(
    folder: Path, faults: Sequence[Fault], before: Callable[[EmulatedHost], Any] = lambda _: None
) -> list[Finding]:
    """Findings on a computer that is in good health but for these faults; devices are not asked who they are."""

    async def main(clock: VirtualClock) -> list[Finding]:
        clock.step_real(NOW)
        made = emulated(folder, clock)
        calibrated(made)
        before(made)
        for fault in faults:
            fault.change(made)
        return await examine(made.context, ask_devices=False)

    return run_virtual(main)


def fits(fault: Fault, others: Sequence[Fault]) -> bool:
    """Whether a fault neither hides one of the others nor is hidden by it."""
    return all(
        fault.touches and one.touches and not fault.touches & one.touches and fault.check != one.check for one in others
    )


def drawn(rng: np.random.Generator, most: int = 4) -> list[Fault]:
    """Up to ``most`` faults that do not hide each other."""
    chosen: list[Fault] = []
    for index in rng.permutation(len(FAULTS))[: int(rng.integers(1, most + 1))].tolist():
        if fits(FAULTS[index], chosen):
            chosen.append(FAULTS[index])
    return chosen


def together() -> list[list[Fault]]:
    """All faults, as many at once as do not hide each other."""
    found: list[list[Fault]] = []
    for fault in FAULTS:
        place = next((others for others in found if fits(fault, others)), None)
        if place is None:
            found.append([fault])
        else:
            place.append(fault)
    return found


def mistakes(findings: Sequence[Finding], faults: Sequence[Fault]) -> list[str]:
    """Faults that were not found or have no mend, and findings that are wrong."""
    bad = [finding for finding in findings if finding.level is not Level.OK]
    found = []
    for fault in faults:
        mine = [one for one in bad if (one.check, one.reason) == (fault.check, fault.reason)]
        if not mine:
            found.append(f"{fault.name}: not found")
        elif not any(fault.mend in f"{one.fix} {one.seen}" for one in mine):
            found.append(f"{fault.name}: no mend in {[(one.seen, one.fix) for one in mine]}")
    expected = {name for fault in faults for name in (fault.check, *fault.also)}
    return found + [f"false: {one.check}: {one.seen}" for one in bad if one.check not in expected]
