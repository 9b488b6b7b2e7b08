"""Tables of device roles and device kinds; every list of devices derives from them.

A role is the purpose of a device: its key in the configuration, the topics it writes and reads, and its place in the
start order. A kind is a product with its driver; its name is the value of ``kind:``. Other distributions may add roles
and kinds: ``docs/writing-a-driver.md``. A kind's modules are loaded on first use, so that listing kinds, checking a
configuration and ``--help`` stay fast.
"""

import json
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any, Final, Literal, NamedTuple

from monstertruck_drivers.arduino_bridge.protocol import BOARD_BAUD
from monstertruck_drivers.ax12.protocol import AX12_BAUD
from monstertruck_drivers.bno085.protocol import BNO085_BAUD
from monstertruck_drivers.cable import DeviceEnd
from monstertruck_drivers.emulation import Emulator, EmulatorSetup, FileEmulator
from monstertruck_drivers.epos.protocol import EPOS_BAUD
from monstertruck_drivers.ld19.protocol import LD19_BAUD
from monstertruck_drivers.link import Framing
from monstertruck_drivers.os4000.protocol import FACTORY_BAUD as OS4000_BAUD
from monstertruck_drivers.receiver.protocol import CRSF_BAUD, SBUS_BAUD
from monstertruck_drivers.steppers.protocol import STEPPERS_BAUD
from monstertruck_drivers.vesc.protocol import VESC_BAUD
from monstertruck_drivers.wt61.protocol import WT61_BAUD
from monstertruck_runtime.clock import Clock
from monstertruck_runtime.errors import InputError
from monstertruck_runtime.plugins import Catalog, Plugin
from monstertruck_schemas import topics
from monstertruck_schemas.base import Schema
from monstertruck_schemas.roles import SHAFTS, DeviceRole, ServiceName
from monstertruck_schemas.topics import CMD_DRIVES, DRIVES, Topic, Writer


class Duty(StrEnum):
    """Purpose of a device on the truck."""

    ACTUATOR = "actuator"
    """Executes the gate's commands; outlives the gate, and a bug in its driver ends the daemon."""
    SENSOR = "sensor"
    MONITOR = "monitor"
    """Reads the computer's own files; configured under ``monitors``."""


@dataclass(frozen=True, kw_only=True)
class RoleSpec:
    """Purpose of a device, independent of its kind."""

    name: str
    """Key in the configuration, name of the service, frame of the measurements."""
    duty: Duty
    doc: str
    writes: Mapping[str, Topic[Any]]
    """Topics written, by driver parameter. The first is the role's main topic. If another one is the main topic of
    another configured device, the driver gets None for it.
    """
    reads: Mapping[str, Topic[Any]] = field(default_factory=dict)
    """Topics read, by driver parameter; the driver receives the latest message of each."""
    frame: bool = False
    """Whether the frame tree contains its mount."""
    elements: str | None = None
    """Settings field that lists several sensing elements by name; the frame tree contains their mounts as
    ``<role>_<name>``.
    """
    start: int = 11
    """Rank among the devices that restart after their hub returned: by default with the sensors, before devices that
    load the hub.
    """
    shafts: tuple[int, ...] = ()
    """Driven shafts it may control, limited to the number in its settings (``shafts``); otherwise the first one."""
    loads_hub: bool = False
    """Whether it draws current (a motor, an image sensor) or bandwidth as soon as its driver starts it."""

    @property
    def topic(self) -> Topic[Any]:
        """The role's main topic."""
        return next(iter(self.writes.values()))


def _shaft(index: int) -> RoleSpec:
    ordinal = ("first", "second", "third", "fourth")[index]
    return RoleSpec(
        name=SHAFTS[index].value,
        duty=Duty.ACTUATOR,
        doc=f"Controller of the body's {ordinal} driven shaft{' (optional)' if index else ''}",
        writes={"out": DRIVES[index]},
        reads={"commands": CMD_DRIVES[index]},
        start=index,
        shafts=(index,),
    )


def _by_shaft(name: str, of_shafts: tuple[Topic[Any], ...]) -> dict[str, Topic[Any]]:
    """Driver parameters for several shafts: ``name``, ``name_2`` and so on."""
    return {f"{name}_{i}" if i > 1 else name: topic for i, topic in enumerate(of_shafts, 1)}


def _lidar(role: DeviceRole, doc: str, scan: Topic[Any]) -> RoleSpec:
    return RoleSpec(
        name=role.value, duty=Duty.SENSOR, doc=doc, writes={"out": scan}, frame=True, start=12, loads_hub=True
    )


LIDAR: Final = _lidar(DeviceRole.LIDAR, "Laser scanner", topics.SCAN)
LIDAR_2: Final = _lidar(DeviceRole.LIDAR_2, "Second laser scanner, such as one that looks backwards", topics.SCAN_2)
DRIVE, DRIVE_2, DRIVE_3, DRIVE_4 = map(_shaft, range(len(SHAFTS)))
WHEELS: Final = RoleSpec(
    name=DeviceRole.WHEELS.value,
    duty=Duty.ACTUATOR,
    doc="One controller for all driven shafts, instead of one for each",
    writes=_by_shaft("out", DRIVES),
    reads=_by_shaft("commands", CMD_DRIVES),
    start=4,
    shafts=tuple(range(len(SHAFTS))),
)
ACTUATORS: Final = RoleSpec(
    name=DeviceRole.ACTUATORS.value,
    duty=Duty.ACTUATOR,
    doc="One controller for all driven shafts, which may also steer and measure the battery, instead of one for each",
    writes={**_by_shaft("out", DRIVES), "steering": topics.STEERING, "battery": topics.BATTERY},
    reads={**_by_shaft("commands", CMD_DRIVES), "steering_commands": topics.CMD_STEERING, "drive": topics.DRIVE},
    start=4,
    shafts=tuple(range(len(SHAFTS))),
)
STEERING: Final = RoleSpec(
    name=DeviceRole.STEERING.value,
    duty=Duty.ACTUATOR,
    doc="Servo controller of the axles, which may also measure the battery",
    writes={"out": topics.STEERING, "battery": topics.BATTERY},
    reads={"commands": topics.CMD_STEERING, "drive": topics.DRIVE},
    start=10,
)
COMPASS: Final = RoleSpec(
    name=DeviceRole.COMPASS.value,
    duty=Duty.SENSOR,
    doc="Heading and tilt",
    writes={"out": topics.COMPASS},
    frame=True,
    start=11,
)
STABILISER: Final = RoleSpec(
    name=DeviceRole.STABILISER.value,
    duty=Duty.SENSOR,
    doc=(
        "Mount of the lidar; its own mount is the point about which both joints turn, the lidar's is the "
        "one with level joints"
    ),
    writes={"out": topics.STABILISER},
    reads={"commands": topics.PLAN_STABILISER},
    frame=True,
    start=13,
)
CAMERA: Final = RoleSpec(
    name=DeviceRole.CAMERA.value,
    duty=Duty.SENSOR,
    doc="Supervision camera",
    writes={"out": topics.CAMERA},
    frame=True,
    start=14,
    loads_hub=True,
)
SONAR: Final = RoleSpec(
    name=DeviceRole.SONAR.value,
    duty=Duty.SENSOR,
    doc="Ultrasonic range finders around the robot",
    writes={"out": topics.SONAR},
    elements="sonars",
    start=11,
)
IMU: Final = RoleSpec(
    name=DeviceRole.IMU.value,
    duty=Duty.SENSOR,
    doc="Angular velocity and specific force",
    writes={"out": topics.IMU},
    frame=True,
    start=11,
)
ENCODERS: Final = RoleSpec(
    name=DeviceRole.ENCODERS.value,
    duty=Duty.SENSOR,
    doc="Encoders of the two rear wheels of a tricycle",
    writes={"out": topics.ENCODERS},
    start=11,
)
HAND: Final = RoleSpec(
    name=DeviceRole.HAND.value,
    duty=Duty.SENSOR,
    doc="Receiver of the hand-held radio control; if configured, the robot moves only while it is connected",
    writes={"out": topics.HAND},
    start=5,
)
BATTERY: Final = RoleSpec(
    name=DeviceRole.BATTERY.value,
    duty=Duty.MONITOR,
    doc="Pack voltage from a converter of the kernel's Industrial-IO, instead of the servo controller's input",
    writes={"out": topics.BATTERY},
    reads={"drive": topics.DRIVE},
)
LINK: Final = RoleSpec(
    name=DeviceRole.LINK.value, duty=Duty.MONITOR, doc="Wi-Fi or Ethernet of the computer", writes={"out": topics.LINK}
)
HOST: Final = RoleSpec(
    name=DeviceRole.HOST.value, duty=Duty.MONITOR, doc="Load and heat of the computer", writes={"out": topics.HOST}
)
OUR_ROLES: Final = (
    LIDAR,
    LIDAR_2,
    DRIVE,
    DRIVE_2,
    DRIVE_3,
    DRIVE_4,
    WHEELS,
    ACTUATORS,
    STEERING,
    COMPASS,
    STABILISER,
    CAMERA,
    SONAR,
    IMU,
    ENCODERS,
    HAND,
    BATTERY,
    LINK,
    HOST,
)
"""Roles in listing and start order."""


class UsbIdentity(NamedTuple):
    """USB identity of a device; the emulated computer also uses it."""

    usb_id: str
    """``vendor:product``."""
    title: str
    node: Literal["ttyACM", "ttyUSB", "video"]
    """Kind of its device node."""


@dataclass(frozen=True, kw_only=True)
class DeviceKind(Plugin):
    """One kind of device; ``implementation`` is its driver.

    A driver is a ``Service``. Its constructor takes the settings, the port and the clock; its role's topics, ``events``
    and ``name`` are keyword arguments.
    """

    roles: tuple[RoleSpec, ...]
    """Roles it can fill."""
    emulator: str
    """``module:function`` that builds an ``Emulator`` (a ``FileEmulator`` for a monitor) from an ``EmulatorSetup``."""
    identity: str
    """``module:function`` of a coroutine function. It takes the object that ``identify`` opens, the clock and the
    driver's settings, and returns facts by name (JSON-compatible), without motion.
    """
    also: Mapping[str, Topic[Any]] = field(default_factory=dict)
    """Topics written in addition to the role's topics, by the driver's parameter. The driver gets None if the topic is
    the main topic of another configured device."""
    opens: Literal["serial", "i2c", "video", "computer"] = "serial"
    """Input of the driver: the ``Port`` of a serial line or of an I2C bus, a ``FrameSource``, or the ``Computer``."""
    baud: int | None = None
    """Baud rate of its serial line; None if the device is USB throughout and any rate works."""
    framing: Framing | None = None
    """Bits per byte on its serial line; None: 8N1."""
    usb: UsbIdentity | None = None
    current: bool = False
    """Whether a motor controller measures the current of each motor."""

    @property
    def role(self) -> RoleSpec:
        """The kind's primary role."""
        return self.roles[0]

    async def serve(self, emulator: Emulator, end: DeviceEnd) -> None:
        """Run an emulated device until cancelled.

        Raises:
            InputError: the emulator's code raised an exception.
        """
        with self.refusing(self.emulator):
            await emulator.run(end)

    def emulated(self, setup: EmulatorSetup) -> Any:
        """Create an emulated device: an ``Emulator``, or a ``FileEmulator`` for a monitor; loads its module.

        Raises:
            InputError: the factory cannot be loaded, or returns an object of another type.
        """
        made, wanted = self.called(self.emulator, setup), FileEmulator if self.opens == "computer" else Emulator
        if not isinstance(made, wanted):
            missing = ", ".join(name for name in ("name", "run", "power_cycle", "inject") if name not in dir(made))
            text = f"expected an emulator, found {type(made).__name__} without {missing}"
            raise InputError(f"kind {self.name}: {self.emulator}: {text}")
        return made

    async def identify(self, where: Any, clock: Clock, settings: Schema | None = None) -> dict[str, Any]:
        """Identify the connected device without moving it.

        Args:
            where: ``Port`` for a serial line or an I2C bus, path of a video device, or the ``Computer``.
            clock: time.
            settings: driver settings; None for the defaults.

        Returns:
            JSON-compatible dict of the facts reported by the device, preceded by ``device`` and ``port`` if it is on a
            port.

        Raises:
            DeviceLostError: the device is not plugged in.
            DeviceTimeoutError: the device does not answer.
            ProtocolError: the device violates its protocol.
            WrongDeviceError: another device answers.
            PortBusyError: another process holds the port.
        """
        settings = settings or self.default_settings()
        if self.opens not in ("serial", "i2c"):
            return await self._facts(where, clock, settings)
        async with await where.open() as link:
            facts = await self._facts(link, clock, settings)
        return {"device": self.doc, "port": where.name, **facts}

    async def _facts(self, where: Any, clock: Clock, settings: Schema) -> dict[str, Any]:
        """Return the device's identity: JSON-compatible values by name."""
        asking = self.called(self.identity, where, clock, settings)
        with self.refusing(self.identity):
            found = await asking
        place = f"kind {self.name}: {self.identity}"
        if not isinstance(found, dict):
            raise InputError(f"{place}: expected a dict of facts, found {found!r}")
        for name, value in found.items():
            try:
                json.dumps({name: value})
            except (TypeError, ValueError) as error:
                raise InputError(
                    f"{place}: {name}: expected a value that JSON can represent, found {value!r}"
                ) from error
        return found


RESERVED: Final = frozenset(
    {*map(str, ServiceName), "at_present", "controller", "lidars", "measures", "present", "shafts", "steers"}
)
"""Names that roles of other distributions must not use: services that are not devices, and configuration keys that are
not roles (a test compares).
"""


class DeviceCatalog(Catalog[DeviceKind]):
    """All device kinds and roles: built-in ones first, then those from other distributions."""

    def __init__(self, *rows: DeviceKind) -> None:
        super().__init__("monstertruck.devices", *rows)
        self._roles = {role.name: role for role in OUR_ROLES}

    def fault(self, row: Any) -> str | None:
        """Error in another distribution's kind or in a role that it adds; None if there is none."""
        if fault := super().fault(row):
            return fault
        if not row.roles:
            return "expected at least one role"
        if row.baud is not None and row.baud <= 0:
            return f"baud: expected bits per second above 0, found {row.baud}"
        if row.usb is not None and not re.fullmatch(r"[0-9a-f]{4}:[0-9a-f]{4}", row.usb.usb_id):
            return f"usb.usb_id: expected vendor:product such as 0403:6001, found {row.usb.usb_id!r}"
        for role in row.roles:
            if fault := self._fault_of_role(row, role):
                return fault
        self._roles.update({role.name: role for role in row.roles})
        return None

    def _fault_of_role(self, row: DeviceKind, role: RoleSpec) -> str | None:
        if not re.fullmatch(r"[a-z][a-z0-9_]*", role.name) or not role.writes:
            return f"role {role.name!r}: expected a name of lower-case letters, digits and _, and a topic to write"
        if hasattr(Schema, role.name) or role.name in RESERVED:
            return f"role {role.name}: the name is reserved"
        if role.duty is Duty.ACTUATOR and role not in OUR_ROLES:
            return f"role {role.name}: only this repository may define actuators"
        if self._roles.get(role.name, role) != role:
            return f"role {role.name}: another role has the same name"
        if role.elements is not None and role.elements not in row.settings_class().model_fields:
            return f"role {role.name}: elements: {row.settings} has no field {role.elements}"
        written = (*role.writes.values(), *row.also.values())
        if not_its := [t.name for t in written if t.writer is not Writer.DRIVER]:
            return f"role {role.name}: drivers do not write {', '.join(not_its)}"
        if unknown := [t.name for t in written if topics.BY_NAME.get(t.name) != t]:
            return f"role {role.name}: no entry point {', '.join(unknown)} in monstertruck.topics"
        return None

    @property
    def roles(self) -> Mapping[str, RoleSpec]:
        """Roles by name, in listing and start order."""
        len(self)  # reads the entry points
        return self._roles

    def of_role(self, role: str) -> tuple[DeviceKind, ...]:
        """Kinds that can fill a role."""
        return tuple(kind for kind in self.values() if role in (known.name for known in kind.roles))

    def named(self, name: str) -> DeviceKind:
        """Return the kind with a name, or the first kind of a role.

        Raises:
            InputError: the name is unknown.
        """
        kinds = (self[name],) if name in self else self.of_role(name)
        if not kinds:
            if broken := [str(one) for one in self.broken if one.name == name]:
                raise InputError(f"unusable device {broken[0]}")
            known = ", ".join(f"{kind.name} ({kind.role.name})" for kind in self.values())
            raise InputError(f"unknown device {name!r}; known: {known}")
        return kinds[0]


DEVICES: Final = DeviceCatalog(
    DeviceKind(
        name="hokuyo_urg",
        doc="Hokuyo URG-04LX laser scanner (SCIP 1.1 and 2.0)",
        roles=(LIDAR, LIDAR_2),
        settings="monstertruck_drivers.hokuyo_urg.config:HokuyoConfig",
        implementation="monstertruck_drivers.hokuyo_urg.driver:HokuyoDriver",
        emulator="monstertruck_drivers.hokuyo_urg.emulator:emulated",
        identity="monstertruck_drivers.hokuyo_urg.identity:identify",
        usb=UsbIdentity("15d1:0000", "URG-Series USB Driver", "ttyACM"),
    ),
    DeviceKind(
        name="hokuyo_lx",
        doc="Hokuyo UST-10LX, UST-20LX or UTM-30LX-EW laser scanner (SCIP 2.2 over TCP)",
        roles=(LIDAR, LIDAR_2),
        settings="monstertruck_drivers.hokuyo_urg.config:HokuyoLxConfig",
        implementation="monstertruck_drivers.hokuyo_urg.driver:HokuyoDriver",
        emulator="monstertruck_drivers.hokuyo_urg.lx_emulator:emulated",
        identity="monstertruck_drivers.hokuyo_urg.identity:identify",
    ),
    DeviceKind(
        name="ld19",
        doc="LDROBOT LD06, LD19 or STL-19P laser scanner",
        roles=(LIDAR, LIDAR_2),
        settings="monstertruck_drivers.ld19.config:Ld19Config",
        implementation="monstertruck_drivers.ld19.driver:Ld19Driver",
        emulator="monstertruck_drivers.ld19.emulator:emulated",
        identity="monstertruck_drivers.ld19.driver:identify",
        baud=LD19_BAUD,
        usb=UsbIdentity("10c4:ea60", "CP2102 USB to UART Bridge Controller", "ttyUSB"),
    ),
    DeviceKind(
        name="rplidar",
        doc="SLAMTEC RPLIDAR A1, A2, A3, C1, S1 or S2 laser scanner",
        roles=(LIDAR, LIDAR_2),
        settings="monstertruck_drivers.rplidar.config:RplidarConfig",
        implementation="monstertruck_drivers.rplidar.driver:RplidarDriver",
        emulator="monstertruck_drivers.rplidar.emulator:emulated",
        identity="monstertruck_drivers.rplidar.session:identify",
        usb=UsbIdentity("10c4:ea60", "CP2102 USB to UART Bridge Controller", "ttyUSB"),
    ),
    DeviceKind(
        name="sheet_lidar",
        doc="Laser scanner described by its data sheet (frames of this project)",
        roles=(LIDAR, LIDAR_2),
        settings="monstertruck_drivers.sheet_lidar.config:SheetLidarConfig",
        implementation="monstertruck_drivers.sheet_lidar.driver:SheetLidarDriver",
        emulator="monstertruck_drivers.sheet_lidar.emulator:emulated",
        identity="monstertruck_drivers.sheet_lidar.driver:identify",
    ),
    DeviceKind(
        name="epos",
        doc="maxon EPOS 24/1 motor controller (RS232)",
        roles=(DRIVE, DRIVE_2, DRIVE_3, DRIVE_4),
        settings="monstertruck_drivers.epos.config:EposConfig",
        implementation="monstertruck_drivers.epos.driver:EposDriver",
        emulator="monstertruck_drivers.epos.emulator:emulated",
        identity="monstertruck_drivers.epos.identity:identify",
        current=True,
        baud=EPOS_BAUD,
        usb=UsbIdentity("0403:6001", "FT232R USB UART", "ttyUSB"),
    ),
    DeviceKind(
        name="steppers",
        doc="Up to four stepper motors on one microcontroller (line protocol of this project)",
        roles=(WHEELS,),
        settings="monstertruck_drivers.steppers.config:StepperConfig",
        implementation="monstertruck_drivers.steppers.driver:StepperDriver",
        emulator="monstertruck_drivers.steppers.emulator:emulated",
        identity="monstertruck_drivers.steppers.session:identify",
        baud=STEPPERS_BAUD,
        usb=UsbIdentity("1a86:7523", "USB Serial", "ttyUSB"),
    ),
    DeviceKind(
        name="arduino_bridge",
        doc="Two motors with encoders on a microcontroller that speaks ROSArduinoBridge",
        roles=(WHEELS,),
        settings="monstertruck_drivers.arduino_bridge.config:ArduinoBridgeConfig",
        implementation="monstertruck_drivers.arduino_bridge.driver:ArduinoBridgeDriver",
        emulator="monstertruck_drivers.arduino_bridge.emulator:emulated",
        identity="monstertruck_drivers.arduino_bridge.session:identify",
        baud=BOARD_BAUD,
        usb=UsbIdentity("1a86:7523", "USB Serial", "ttyUSB"),
    ),
    DeviceKind(
        name="vesc",
        doc="VESC motor controllers, with servo output and battery reading",
        roles=(ACTUATORS,),
        settings="monstertruck_drivers.vesc.config:VescConfig",
        implementation="monstertruck_drivers.vesc.driver:VescDriver",
        emulator="monstertruck_drivers.vesc.emulator:emulated",
        identity="monstertruck_drivers.vesc.session:identify",
        current=True,
        baud=VESC_BAUD,
        usb=UsbIdentity("0483:5740", "ChibiOS/RT Virtual COM Port", "ttyACM"),
    ),
    DeviceKind(
        name="maestro_esc",
        doc="Radio-control speed controller on a Pololu Maestro that also steers",
        roles=(ACTUATORS,),
        settings="monstertruck_drivers.maestro.esc_config:MaestroEscConfig",
        implementation="monstertruck_drivers.maestro.esc_driver:MaestroEscDriver",
        emulator="monstertruck_drivers.maestro.esc_emulator:emulated",
        identity="monstertruck_drivers.maestro.session:identify",
        usb=UsbIdentity("1ffb:0089", "Pololu Micro Maestro 6-Servo Controller", "ttyACM"),
    ),
    DeviceKind(
        name="maestro",
        doc="Pololu Micro Maestro 6 servo controller with battery input",
        roles=(STEERING,),
        settings="monstertruck_drivers.maestro.config:MaestroConfig",
        implementation="monstertruck_drivers.maestro.driver:MaestroDriver",
        emulator="monstertruck_drivers.maestro.emulator:emulated",
        identity="monstertruck_drivers.maestro.session:identify",
        usb=UsbIdentity("1ffb:0089", "Pololu Micro Maestro 6-Servo Controller", "ttyACM"),
    ),
    DeviceKind(
        name="pca9685_esc",
        doc="Radio-control speed controller on a PCA9685 that also steers",
        roles=(ACTUATORS,),
        settings="monstertruck_drivers.pca9685.config:Pca9685EscConfig",
        implementation="monstertruck_drivers.pca9685.esc_driver:Pca9685EscDriver",
        emulator="monstertruck_drivers.pca9685.emulator:emulated_esc",
        identity="monstertruck_drivers.pca9685.session:identify",
        opens="i2c",
    ),
    DeviceKind(
        name="pca9685",
        doc="NXP PCA9685 servo controller on an I2C bus",
        roles=(STEERING,),
        settings="monstertruck_drivers.pca9685.config:Pca9685Config",
        implementation="monstertruck_drivers.pca9685.driver:Pca9685Driver",
        emulator="monstertruck_drivers.pca9685.emulator:emulated",
        identity="monstertruck_drivers.pca9685.session:identify",
        opens="i2c",
    ),
    DeviceKind(
        name="ax12",
        doc="Two Dynamixel AX-12A on a USB2Dynamixel",
        roles=(STABILISER,),
        settings="monstertruck_drivers.ax12.config:Ax12Config",
        implementation="monstertruck_drivers.ax12.driver:Ax12Driver",
        emulator="monstertruck_drivers.ax12.emulator:emulated",
        identity="monstertruck_drivers.ax12.identity:identify",
        baud=AX12_BAUD,
        usb=UsbIdentity("0403:6001", "USB2Dynamixel", "ttyUSB"),
    ),
    DeviceKind(
        name="webcam",
        doc="V4L2 camera with motion JPEG",
        roles=(CAMERA,),
        settings="monstertruck_drivers.webcam.config:WebcamConfig",
        implementation="monstertruck_drivers.webcam.driver:WebcamDriver",
        emulator="monstertruck_drivers.webcam.emulator:emulated",
        identity="monstertruck_drivers.webcam.identity:identify",
        opens="video",
        usb=UsbIdentity("046d:080a", "Webcam C905", "video"),
    ),
    DeviceKind(
        name="mjpeg",
        doc="Motion JPEG camera, read from a program's output or over the network",
        roles=(CAMERA,),
        settings="monstertruck_drivers.mjpeg.config:MjpegConfig",
        implementation="monstertruck_drivers.mjpeg.driver:MjpegDriver",
        emulator="monstertruck_drivers.mjpeg.emulator:emulated",
        identity="monstertruck_drivers.mjpeg.identity:identify",
    ),
    DeviceKind(
        name="srf08",
        doc="Devantech SRF08 sonars behind a USB-ISS",
        roles=(SONAR,),
        settings="monstertruck_drivers.srf08.config:Srf08Config",
        implementation="monstertruck_drivers.srf08.driver:Srf08Driver",
        emulator="monstertruck_drivers.srf08.emulator:emulated",
        identity="monstertruck_drivers.srf08.session:identify",
        usb=UsbIdentity("04d8:ffee", "USB-ISS", "ttyACM"),
    ),
    DeviceKind(
        name="wt61",
        doc="WitMotion WT61 inertial measurement unit",
        roles=(IMU,),
        settings="monstertruck_drivers.wt61.config:Wt61Config",
        implementation="monstertruck_drivers.wt61.driver:Wt61Driver",
        emulator="monstertruck_drivers.wt61.emulator:emulated",
        identity="monstertruck_drivers.wt61.driver:identify",
        baud=WT61_BAUD,
        usb=UsbIdentity("1a86:7523", "USB2.0-Serial", "ttyUSB"),
    ),
    DeviceKind(
        name="bno085",
        doc="CEVA BNO085 in UART-RVC mode: turn rate, specific force, tilt",
        roles=(IMU,),
        also={"attitude": topics.COMPASS},
        settings="monstertruck_drivers.bno085.config:Bno085Config",
        implementation="monstertruck_drivers.bno085.driver:Bno085Driver",
        emulator="monstertruck_drivers.bno085.emulator:emulated",
        identity="monstertruck_drivers.bno085.driver:identify",
        baud=BNO085_BAUD,
        usb=UsbIdentity("10c4:ea60", "CP2102 USB to UART Bridge Controller", "ttyUSB"),
    ),
    DeviceKind(
        name="roboclaw",
        doc="Encoders of two wheels on a Basicmicro RoboClaw",
        roles=(ENCODERS,),
        settings="monstertruck_drivers.roboclaw.config:RoboclawConfig",
        implementation="monstertruck_drivers.roboclaw.driver:RoboclawDriver",
        emulator="monstertruck_drivers.roboclaw.emulator:emulated",
        identity="monstertruck_drivers.roboclaw.session:identify",
        usb=UsbIdentity("03eb:2404", "USB Roboclaw", "ttyACM"),
    ),
    DeviceKind(
        name="crsf",
        doc="Radio control receiver that speaks CRSF (ExpressLRS, TBS Crossfire)",
        roles=(HAND,),
        settings="monstertruck_drivers.receiver.config:CrsfConfig",
        implementation="monstertruck_drivers.receiver.driver:ReceiverDriver",
        emulator="monstertruck_drivers.receiver.emulator:emulated",
        identity="monstertruck_drivers.receiver.driver:identify",
        baud=CRSF_BAUD,
        usb=UsbIdentity("10c4:ea60", "CP2102N USB to UART Bridge Controller", "ttyUSB"),
    ),
    DeviceKind(
        name="sbus",
        doc="Radio control receiver that speaks SBUS, behind an inverter",
        roles=(HAND,),
        settings="monstertruck_drivers.receiver.config:SbusConfig",
        implementation="monstertruck_drivers.receiver.driver:ReceiverDriver",
        emulator="monstertruck_drivers.receiver.emulator:emulated_sbus",
        identity="monstertruck_drivers.receiver.driver:identify",
        baud=SBUS_BAUD,
        framing="8E2",
        usb=UsbIdentity("0403:6001", "FT232R USB UART", "ttyUSB"),
    ),
    DeviceKind(
        name="iio",
        doc="Battery voltage by a converter of Linux Industrial-IO",
        roles=(BATTERY,),
        settings="monstertruck_drivers.battery.config:IioConfig",
        implementation="monstertruck_drivers.battery.driver:IioBatteryDriver",
        emulator="monstertruck_drivers.battery.emulator:emulated",
        identity="monstertruck_drivers.battery.driver:identify",
        opens="computer",
    ),
    DeviceKind(
        name="link_quality",
        doc="Wi-Fi and Ethernet links of the computer",
        roles=(LINK,),
        settings="monstertruck_drivers.link_quality.config:LinkQualityConfig",
        implementation="monstertruck_drivers.link_quality.driver:LinkQualityDriver",
        emulator="monstertruck_drivers.link_quality.emulator:emulated",
        identity="monstertruck_drivers.link_quality.driver:identify",
        opens="computer",
    ),
    DeviceKind(
        name="host_health",
        doc="Load, heat, memory and disk of the computer",
        roles=(HOST,),
        settings="monstertruck_drivers.host_health.config:HostHealthConfig",
        implementation="monstertruck_drivers.host_health.driver:HostHealthDriver",
        emulator="monstertruck_drivers.host_health.emulator:emulated",
        identity="monstertruck_drivers.host_health.driver:identify",
        opens="computer",
    ),
    DeviceKind(
        name="os4000",
        doc="OceanServer OS4000 compass",
        roles=(COMPASS,),
        settings="monstertruck_drivers.os4000.config:Os4000Config",
        implementation="monstertruck_drivers.os4000.driver:Os4000Driver",
        emulator="monstertruck_drivers.os4000.emulator:emulated",
        identity="monstertruck_drivers.os4000.session:identify",
        baud=OS4000_BAUD,
        usb=UsbIdentity("10c4:ea60", "CP2102 USB to UART Bridge Controller", "ttyUSB"),
    ),
)


def start_order() -> tuple[str, ...]:
    """Roles in the order in which they restart after a hub returns."""
    roles = [role for role in DEVICES.roles.values() if role.duty is not Duty.MONITOR]
    return tuple(role.name for role in sorted(roles, key=lambda role: role.start))


def started_apart() -> tuple[str, ...]:
    """Roles that put a load on their hub when they start."""
    return tuple(role.name for role in DEVICES.roles.values() if role.loads_hub)
